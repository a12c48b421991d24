"""Ratios measured side by side.

The contenders of a row take turns, round after round, so that what slows the machine down slows all of
them; a figure is the median over the rounds, and a ratio the median of the rounds' ratios.
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
# On a machine that others use, the processor's time of this process says more than the wall's; but it
# does not count waiting for the disk.
CLOCK = time.process_time if os.environ.get("BENCH_CLOCK") == "cpu" else time.perf_counter


@dataclass
class Row:
    """One line of the table.

    Attributes:
        work: what is done.
        figures: contender to its figure, in ``unit``.
        unit: of the figures; a rate (``.../s``) is better when larger, a time when smaller.
        targets: what to reach, as named ratio to (least or most, bound).
        ratios: named ratio to its value.
        notes: what else the reader must know.
    """

    work: str
    figures: dict[str, float]
    unit: str
    ratios: dict[str, float] = field(default_factory=dict)
    targets: dict[str, tuple[str, float]] = field(default_factory=dict)
    notes: str = ""

    def reached(self, name: str) -> bool:
        """Return whether the target of a ratio is reached."""
        kind, bound = self.targets[name]
        return self.ratios[name] >= bound if kind == "least" else self.ratios[name] <= bound


def take_turns(
    contenders: Mapping[str, Callable[[], Any]],
    rounds: int,
    *,
    processes: bool = False,
    before: Callable[[], Any] | None = None,
) -> dict[str, list[float]]:
    """Run each contender once a round and return the seconds that each took in each round.

    Args:
        contenders: name to what is run.
        rounds: how many.
        processes: whether contenders work in other processes too; wall time alone counts then.
        before: what is done before each turn, and not counted.
    """
    clock = time.perf_counter if processes else CLOCK
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    names = list(contenders)
    for number in range(rounds):
        # Not always in the same order: who comes second may find a warm cache, or a hot processor.
        for name in names if number % 2 == 0 else reversed(names):
            if before is not None:
                before()
            gc.collect()
            start = clock()
            contenders[name]()
            seconds[name].append(clock() - start)
    return seconds


def ratio(over: list[float], under: list[float]) -> float:
    """Return the median of the rounds' ratios."""
    return median(a / b for a, b in zip(over, under, strict=True))


def rates(seconds: Mapping[str, list[float]], amount: float) -> dict[str, float]:
    """Return the median rate of each contender at ``amount`` units a run."""
    return {name: amount / median(values) for name, values in seconds.items()}


def times(seconds: Mapping[str, list[float]], scale: float = 1.0) -> dict[str, float]:
    """Return the median time of each contender, times ``scale``."""
    return {name: median(values) * scale for name, values in seconds.items()}


def peak_memory() -> int:
    """Return this process's peak resident memory in bytes; ``ru_maxrss`` would include its parent's."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])


def table(rows: list[Row]) -> str:
    """Return the rows as a Markdown table."""
    lines = ["| work | figures | ratios | to reach | |", "|---|---|---|---|---|"]
    for row in rows:
        figures = "; ".join(f"{name} {value:,.4g}" for name, value in row.figures.items()) + f" {row.unit}"
        ratios = "; ".join(f"{name} {value:.3g}" for name, value in row.ratios.items())
        targets = "; ".join(f"{name} at {kind} {bound:g}" for name, (kind, bound) in row.targets.items())
        verdict = ", ".join("reached" if row.reached(name) else "missed" for name in row.targets)
        work = f"{row.work} ({row.notes})" if row.notes else row.work
        lines.append(f"| {work} | {figures} | {ratios} | {targets} | {verdict} |")
    return "\n".join(lines)
