"""Measurement of ratios between contenders.

The contenders of a row run in turns, so a slow phase of the machine affects all of them. A figure is the
median over the rounds. A ratio is the median of the ratios of the rounds.
"""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

OURS, STOCK, LIMIT = "ours", "stock", "limit"
# On a busy machine, processor time is more reliable than wall time, but it does not count waiting for the
# disk.
CLOCK = time.process_time if os.environ.get("BENCH_CLOCK") == "cpu" else time.perf_counter


@dataclass
class Row:
    """One row of the table.

    Attributes:
        work: description of the measured work.
        figures: maps each contender to its figure, in ``unit``.
        unit: unit of the figures. A higher rate (``.../s``) is better, a lower time is better.
        ratios: maps the name of each ratio to its value.
        targets: maps the name of a ratio to its target: "least" or "most", and the bound.
        notes: remarks on the measurement.
    """

    work: str
    figures: dict[str, float]
    unit: str
    ratios: dict[str, float] = field(default_factory=dict)
    targets: dict[str, tuple[str, float]] = field(default_factory=dict)
    notes: str = ""

    def reached(self, name: str) -> bool:
        """Return whether a ratio reaches its target."""
        kind, bound = self.targets[name]
        return self.ratios[name] >= bound if kind == "least" else self.ratios[name] <= bound


def take_turns(
    contenders: Mapping[str, Callable[[], Any]],
    rounds: int,
    *,
    processes: bool = False,
    before: Callable[[], Any] | None = None,
) -> dict[str, list[float]]:
    """Run each contender once per round and return its times in seconds, one per round.

    Args:
        contenders: maps names to the functions to run.
        rounds: number of rounds.
        processes: whether contenders use other processes too. Wall time is measured then.
        before: called before each run, outside the measured time.
    """
    clock = time.perf_counter if processes else CLOCK
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    names = list(contenders)
    for number in range(rounds):
        # The order alternates, because the second contender may find a warm cache or a hot processor.
        for name in names if number % 2 == 0 else reversed(names):
            if before is not None:
                before()
            gc.collect()
            start = clock()
            contenders[name]()
            seconds[name].append(clock() - start)
    return seconds


def ratio(over: list[float], under: list[float]) -> float:
    """Return the median of the ratios of the rounds."""
    return median(a / b for a, b in zip(over, under, strict=True))


def rates(seconds: Mapping[str, list[float]], amount: float) -> dict[str, float]:
    """Return the median rate of each contender, for ``amount`` units per run."""
    return {name: amount / median(values) for name, values in seconds.items()}


def times(seconds: Mapping[str, list[float]], scale: float = 1.0) -> dict[str, float]:
    """Return the median time of each contender, times ``scale``."""
    return {name: median(values) * scale for name, values in seconds.items()}


def peak_memory() -> int:
    """Return this process's peak resident memory in bytes. ``ru_maxrss`` would include its parent's."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])


def table(rows: list[Row]) -> str:
    """Return the rows as a Markdown table."""
    lines = ["| work | figures | ratios | target | |", "|---|---|---|---|---|"]
    for row in rows:
        figures = "; ".join(f"{name} {value:,.4g}" for name, value in row.figures.items()) + f" {row.unit}"
        ratios = "; ".join(f"{name} {value:.3g}" for name, value in row.ratios.items())
        targets = "; ".join(f"{name} at {kind} {bound:g}" for name, (kind, bound) in row.targets.items())
        verdict = ", ".join("reached" if row.reached(name) else "missed" for name in row.targets)
        work = f"{row.work} ({row.notes})" if row.notes else row.work
        lines.append(f"| {work} | {figures} | {ratios} | {targets} | {verdict} |")
    return "\n".join(lines)
