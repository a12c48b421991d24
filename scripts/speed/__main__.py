"""Run the benchmarks, print their table and write them as JSON."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

ROWS = ("collect", "jobs", "combine", "load", "sample", "verify", "start", "publish", "train")


def main() -> None:
    """Parse the arguments and run the benchmarks."""
    parser = argparse.ArgumentParser(prog="scripts/bench", description=__doc__)
    parser.add_argument("rows", nargs="*", help=f"rows to run: {', '.join(ROWS)}; default: all except train")
    parser.add_argument("--rounds", type=int, default=5, help="number of runs of each contender")
    parser.add_argument("--scale", type=float, default=1.0, help="share of the work; 0.1 for a quick try")
    parser.add_argument(
        "--output", type=Path, default=Path("benchmark.json"), help="JSON file of the figures"
    )
    parser.add_argument(
        "--cpu", action="store_true", help="measure processor time of single-process rows, for a busy machine"
    )
    options = parser.parse_args()
    if options.cpu:
        os.environ["BENCH_CLOCK"] = "cpu"
    unknown = set(options.rows) - set(ROWS)
    if unknown:
        parser.error(f"unknown row {unknown.pop()!r}; valid: {', '.join(ROWS)}")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["MINARI_DATASETS_PATH"] = str(Path(folder) / "root")
        rows = _run_rows(set(options.rows) or set(ROWS) - {"train"}, options)
    from scripts.speed.measuring import table

    print("\n" + table(rows))
    print(f"\nfigures written to {options.output}")


def _run_rows(wanted: set[str], options: argparse.Namespace) -> list:
    from imujoco_minari.variants import ROBOTS, Variant
    from scripts.speed import collecting, datasets, starting, training
    from scripts.speed.subjects import publish_copies

    scale, rounds = options.scale, options.rounds
    rows = []

    def add_rows(*new) -> None:
        rows.extend(new)
        for row in new:
            ratios = ", ".join(f"{name} {value:.3g}" for name, value in row.ratios.items())
            print(f"{time.strftime('%X')} {row.work}: {ratios}", file=sys.stderr, flush=True)
        # Written after each row, so a failing row does not lose the others.
        figures = {
            "machine": _describe_machine(),
            "clock": "cpu" if options.cpu else "wall",
            "rounds": rounds,
            "rows": list(map(asdict, rows)),
        }
        options.output.write_text(json.dumps(figures, indent=1))

    collected = {}
    if wanted & {"collect", "publish"}:
        for robot in ROBOTS:
            collected[robot] = collecting.collection_row(robot, rounds, int(20_000 * scale))
            add_rows(collected[robot])
    if wanted & {"jobs", "publish"}:
        jobs = collecting.jobs_row(max(1, rounds // 2), max(2, int(20 * scale)))
        add_rows(jobs)
    if "publish" in wanted:
        scaling = jobs.ratios["times one process"]
        add_rows(collecting.publishing_row(max(5, int(50 * scale)), scaling, collected))
    if wanted & {"combine", "load", "sample"}:
        ids = publish_copies(Variant.parse("halfcheetah-base"), int(100 * scale), 20)
        if "combine" in wanted:
            add_rows(datasets.combining_row(ids, rounds))
        if "load" in wanted:
            add_rows(datasets.loading_row(ids, rounds))
        if "sample" in wanted:
            add_rows(*datasets.sampling_rows(ids, rounds))
    if "verify" in wanted:
        add_rows(collecting.verification_row(rounds, int(200 * scale), collecting.cores()))
    if "start" in wanted:
        add_rows(*starting.starting_rows(max(3, 2 * rounds)))
    if "train" in wanted:
        add_rows(training.training_row(120.0 * scale))
    return rows


def _describe_machine() -> dict:
    names = ("imujoco-minari", "mujoco", "gymnasium", "minari", "numpy", "h5py", "stable-baselines3", "torch")
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "load": os.getloadavg(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in names},
    }


if __name__ == "__main__":
    main()
