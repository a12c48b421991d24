"""Offline reinforcement learning on the bases' datasets: the cells ``offline-v1``, and how they run.

A cell trains one algorithm on one dataset with one seed, and evaluates its policies on the base robot. A
policy of ``medium-expert`` data is evaluated on some variants too, which its data do not contain.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from imujoco_minari.benchmark.evaluating import episode_returns
from imujoco_minari.benchmark.iql import Iql
from imujoco_minari.benchmark.lines import (
    Line,
    data_sha256,
    measure_each,
    policies_sha256,
    references,
    run_lines,
    versions,
)
from imujoco_minari.benchmark.methods import settings_of
from imujoco_minari.benchmark.offline_cloning import Cloning
from imujoco_minari.benchmark.protocol import EVALUATION_EPISODES
from imujoco_minari.benchmark.td3_bc import Td3Bc
from imujoco_minari.errors import BenchmarkChoiceError, BenchmarkError
from imujoco_minari.loading import Arrays, arrays
from imujoco_minari.policies import Actor
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.storage import minari_root
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.variants import ROBOTS, Variant

NAME = "offline-v1"
FILE = "offline.jsonl"
CELL = ("protocol", "method", "robot", "tier", "seed", "checkpoints")
UPDATES = 250_000
# The policy is evaluated after these parts of the updates.
PARTS = (0.1, 0.2, 0.4, 1.0)
SEEDS = 3
TIERS = ("medium", "medium-replay", "medium-expert")
# The policies of these tiers sample their actions, as those of D4RL do: `imujoco publish --stochastic`. Modes
# give data with one action for each state, on which the critics of TD3+BC diverge.
SAMPLED_TIERS = ("medium", "medium-expert")
# A policy of this tier's data is evaluated on these variants too: a strong change of each category, on which
# the base's expert scores less than 1 if the category has such a variant.
SHIFTED_TIER = "medium-expert"
SHIFTED_VARIANTS = (
    "hopper-massinc_100_torsogeom",
    "hopper-jointdec_50_footjoint",
    "hopper-lengthinc_50_thighgeom",
    "hopper-frictiondec_50_feet",
    "halfcheetah-massinc_100_bfoot",
    "halfcheetah-jointdec_50_bthigh",
    "halfcheetah-lengthinc_50_bshin",
    "halfcheetah-frictiondec_50_feet",
    "walker2d-massinc_200_torsogeom",
    "walker2d-jointdec_50_thighjoint",
    "walker2d-lengthinc_50_leggeom",
    "walker2d-frictiondec_50_feet",
)
# Measured on one core.
SECONDS_PER_UPDATE = {"bc": 0.0005, "bc-10%": 0.0005, "td3+bc": 0.0016, "iql": 0.0022}


class Algorithm(Protocol):
    """Learns a policy from a dataset."""

    def train(self, data: Arrays) -> Mapping[int, Actor]:
        """Return the policy that was learnt from the data at each checkpoint, a number of updates."""


# Returns an algorithm for a seed and checkpoints.
NewAlgorithm = Callable[[int, tuple[int, ...]], Algorithm]
ALGORITHMS: Mapping[str, NewAlgorithm] = {
    "bc": Cloning,
    "bc-10%": partial(Cloning, best=0.1),
    "td3+bc": Td3Bc,
    "iql": Iql,
}


@dataclass(frozen=True)
class OfflineGrid:
    """The cells of a run: all combinations of these methods, robots, tiers and seeds.

    Attributes:
        methods: names of the algorithms.
        robots: the robots.
        tiers: tiers of the datasets.
        seeds: seeds of the algorithms.
        updates: number of updates. Policies after a tenth, a fifth and two fifths of them are evaluated too.
        episodes: number of episodes of each evaluation.
    """

    methods: Sequence[str] = tuple(ALGORITHMS)
    robots: Sequence[str] = ROBOTS
    tiers: Sequence[str] = TIERS
    seeds: Sequence[int] = tuple(range(SEEDS))
    updates: int = UPDATES
    episodes: int = EVALUATION_EPISODES

    def __post_init__(self) -> None:
        for word, given, valid in (
            ("algorithm", self.methods, tuple(ALGORITHMS)),
            ("robot", self.robots, ROBOTS),
            ("tier", self.tiers, TIERS),
        ):
            unknown = sorted(set(given) - set(valid))
            if unknown:
                raise BenchmarkChoiceError(f"no {word} {unknown[0]!r} here; valid: {', '.join(valid)}")

    def cells(self) -> int:
        """Return the number of cells."""
        return len(self.methods) * len(self.robots) * len(self.tiers) * len(self.seeds)

    def checkpoints(self) -> list[int]:
        """Return the numbers of updates after which a policy is evaluated."""
        return sorted({max(1, round(part * self.updates)) for part in PARTS})

    def seconds(self) -> float:
        """Return about how long one process computes the cells."""
        each = sum(SECONDS_PER_UPDATE[name] for name in self.methods) * self.updates
        return self.cells() / len(self.methods) * each

    def recipes(self) -> list[Recipe]:
        """Return the recipes of the datasets that the cells need."""
        return [
            Recipe(Variant(robot), tier, stochastic=tier in SAMPLED_TIERS)
            for robot in self.robots
            for tier in self.tiers
        ]


def run_offline(
    grid: OfflineGrid,
    results: Path,
    *,
    jobs: int = 1,
    on_cells: Callable[[int], None] = lambda cells: None,
) -> list[Line]:
    """Compute the cells of a grid that a results folder lacks, and return the lines of all of them.

    Args:
        grid: the cells.
        results: folder of ``offline.jsonl``.
        jobs: number of processes. The results do not depend on it.
        on_cells: called with the number of cells that have become known.

    Raises:
        DatasetNotFoundError: if a dataset is not in the Minari root.
        BenchmarkError: if the actions of a dataset are not sampled, a variant has no expert, or a process
            was lost.
        StorageError: if a line cannot be written.
    """
    for recipe in grid.recipes():
        _check_sampled(recipe)
    compute = partial(measure_each, _run_cell, jobs)
    return run_lines(results / FILE, compute, list(_lines(grid)), on_cells)


def _lines(grid: OfflineGrid) -> Iterator[Line]:
    # All cells of a dataset share its digest, and all cells share the versions.
    digest, present = cache(data_sha256), versions()
    for seed in grid.seeds:
        for robot in grid.robots:
            base = Variant(robot)
            shifted = [variant for variant in map(Variant.parse, SHIFTED_VARIANTS) if variant.robot == robot]
            for tier in grid.tiers:
                variants = (base, *(shifted if tier == SHIFTED_TIER else ()))
                for name in grid.methods:
                    yield {
                        "protocol": NAME,
                        "method": name,
                        "settings": algorithm_settings(name),
                        "robot": robot,
                        "tier": tier,
                        "seed": seed,
                        "checkpoints": grid.checkpoints(),
                        "episodes": grid.episodes,
                        "variants": [str(variant) for variant in variants],
                        "data_sha256": digest((base.dataset_id(tier),)),
                        "policies_sha256": policies_sha256(variants),
                        "versions": present,
                    }


def _check_sampled(recipe: Recipe) -> None:
    """Raise a BenchmarkError if a dataset needs sampled actions but has the policies' modes."""
    metadata = read_metadata(minari_root.dataset_folder(recipe.dataset_id) / "data")
    if recipe.stochastic and metadata.get("policy_deterministic"):
        raise BenchmarkError(
            f"{recipe.dataset_id} has deterministic actions, but {NAME} needs sampled ones: replace it with "
            f"`imujoco publish {recipe.variant} --tier {recipe.tier} --stochastic --force`"
        )


def _run_cell(line: Line) -> Line:
    start = time.process_time()
    data = arrays(Variant(line["robot"]).dataset_id(line["tier"]), dtype=np.float32)
    policies = ALGORITHMS[line["method"]](line["seed"], tuple(line["checkpoints"])).train(data)
    training = time.process_time() - start
    variants = [Variant.parse(variant) for variant in line["variants"]]
    found = {
        str(variant): {
            str(updates): {"returns": episode_returns(policy, variant, line["episodes"])}
            for updates, policy in policies.items()
        }
        for variant in variants
    }
    return {
        **line,
        "references": {str(variant): references(variant) for variant in variants},
        "results": found,
        "seconds": [round(training, 1), round(time.process_time() - start - training, 1)],
    }


def algorithm_settings(name: str) -> dict[str, Any]:
    """Return the settings of an algorithm, for its lines: all but the seed and the checkpoints."""
    settings = settings_of(ALGORITHMS[name](0, ()))
    del settings["checkpoints"]
    return settings
