"""The returns of the universal policies, as shares of the base expert's, on seeds that chose no policy."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.errors import VariantError
from imujoco_minari.parallel import run_jobs
from imujoco_minari.policies import own_record, universal_policy
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.universal import read_universal
from imujoco_minari.variants import ROBOTS, Change, Variant, catalogue
from imujoco_minari.variants.off_dynamics import off_dynamics, off_dynamics_names
from imujoco_minari.variants.ranges import drawing_ranges

SEED = 77_000_000


def unseen(robot: str, count: int, changes: int) -> list[Variant]:
    """Return variants with this number of changes of listed categories, drawn evenly, none of them listed."""
    rng, ranges = np.random.default_rng(SEED + changes), drawing_ranges(robot)
    names, listed, found = list(ranges), set(catalogue(robot)), []
    while len(found) < count:
        drawn = [names[index] for index in rng.choice(len(names), changes, replace=False)]
        parts = []
        for name in drawn:
            category, _, body = name.partition("/")
            low, high = ranges[name]
            parts.append(Change(category, int(rng.integers(int(low), int(high) + 1)), body))
        try:
            variant = Variant(robot, tuple(parts))
        except VariantError:
            continue
        if variant not in listed and all(part.percent for part in parts):
            found.append(variant)
    return found


def measure(job: tuple[Variant, Path | None, int]) -> tuple[float, bool]:
    """Return the mean return of the folded policy, and whether it fell in one of its episodes."""
    variant, weights, episodes = job
    universal = universal_policy(variant.robot) if weights is None else read_universal(weights)
    assert universal is not None
    result = evaluate(variant, universal.fold(variant), episodes=episodes, seed=SEED)
    return result.return_mean, bool(result.lengths.min() < 1000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", choices=ROBOTS, action="append")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--unseen", type=int, default=60)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--weights", type=Path, help="a universal policy's file instead of the present one")
    given = parser.parse_args()
    for robot in given.robot or ROBOTS:
        base = own_record(Variant(robot))["evaluation"]["return_mean"]
        groups: dict[str, list[Variant]] = {"listed": list(catalogue(robot))}
        groups["single"] = unseen(robot, given.unseen, 1)
        groups["pair"] = unseen(robot, given.unseen, 2)
        groups["odrl"] = [off_dynamics(name).target for name in off_dynamics_names(robot)]
        for name, variants in groups.items():
            jobs: list[Any] = [(variant, given.weights, given.episodes) for variant in variants]
            found = dict(run_jobs(measure, jobs, jobs=given.jobs))
            shares = np.array([found[number][0] / base for number in range(len(jobs))])
            falls = [str(variants[number]) for number in range(len(jobs)) if found[number][1]]
            weakest = ", ".join(f"{variants[i]} {shares[i]:.2f}" for i in np.argsort(shares)[:5])
            print(
                f"{robot} {name} ({len(shares)}): median {np.median(shares):.3f}, lowest {shares.min():.3f}, "
                f"below 0.95 {np.sum(shares < 0.95)}, below 0.8 {np.sum(shares < 0.8)}, falls {len(falls)}; "
                f"weakest: {weakest}",
                flush=True,
            )
            if name == "odrl":
                listed = zip(off_dynamics_names(robot), shares, strict=True)
                print("    " + ", ".join(f"{task} {share:.2f}" for task, share in listed), flush=True)


if __name__ == "__main__":
    main()
