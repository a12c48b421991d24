"""Offline reinforcement learning: the cells ``offline-v1`` and ``across-v1``, and how they run.

A cell of ``offline-v1`` trains one algorithm on a dataset of a base robot with one seed, and evaluates its
policies on the base robot. A policy of ``medium-expert`` data is evaluated on some variants too, which its
data do not contain. A cell of ``across-v1`` trains on the datasets of all training variants of a split, and
evaluates on the held-out variants.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from imujoco_minari.benchmark.cloning import Cloning, contexts_of
from imujoco_minari.benchmark.critics import Iql, Td3Bc
from imujoco_minari.benchmark.lines import (
    Line,
    data_sha256,
    identity,
    measure_each,
    named,
    policies_sha256,
    read_lines,
    references,
    run_lines,
    versions,
)
from imujoco_minari.benchmark.methods import settings_of
from imujoco_minari.benchmark.protocol import EVALUATION_EPISODES, episode_returns
from imujoco_minari.errors import BenchmarkChoiceError, BenchmarkError
from imujoco_minari.loading import Arrays, arrays
from imujoco_minari.policies.tiers import LARGE_TIERS
from imujoco_minari.policies.universal import UniversalPolicy
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.short_repr import short_repr
from imujoco_minari.storage import minari_root
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.variants import ROBOTS, Variant, held_out

NAME, ACROSS = "offline-v1", "across-v1"
FILE, ACROSS_FILE = "offline.jsonl", "across.jsonl"
CELL = ("protocol", "method", "robot", "tier", "seed", "checkpoints")
# The split of a robot in across-v1.
ACROSS_SPLIT = "{}-random-v1"
UPDATES = 250_000
# The policy is evaluated after these numbers of updates.
CHECKPOINTS = (25_000, 50_000, 100_000, UPDATES)
SEEDS = 5
# An expensive algorithm of others may have fewer seeds.
LEAST_SEEDS = 3
TIERS = ("medium", "medium-replay", "medium-expert")
# The cells of the large tiers are computed only if they are named.
ALL_TIERS = (*TIERS, *LARGE_TIERS)
# The policies of these tiers sample their actions, as those of D4RL do: `imujoco publish --stochastic`. Modes
# give data with one action for each state, on which the critics of TD3+BC diverge.
SAMPLED_TIERS = ("medium", "medium-expert", *LARGE_TIERS)
EPISODES, LARGE_EPISODES = 100, 1000
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
SECONDS_PER_UPDATE = {"bc": 0.0004, "bc-10%": 0.0004, "td3+bc": 0.0014, "iql": 0.0019}
SECONDS_PER_UPDATE |= {"bc-told": 0.0005, "iql-told": 0.0021}


class Algorithm(Protocol):
    """Learns a policy from a dataset."""

    def train(self, data: Arrays) -> Mapping[int, Any]:
        """Return the policy that was learnt from the data at each checkpoint, a number of updates.

        A :class:`~imujoco_minari.policies.universal.UniversalPolicy` is told each variant that it acts in.
        """


# Returns an algorithm for a seed and checkpoints.
NewAlgorithm = Callable[[int, tuple[int, ...]], Algorithm]


class Told:
    """An algorithm that is told the variant: its context follows the observation."""

    def __init__(self, new: NewAlgorithm, seed: int, checkpoints: tuple[int, ...]) -> None:
        self._algorithm = new(seed, checkpoints)
        vars(self).update(vars(self._algorithm), told=True)

    def train(self, data: Arrays) -> dict[int, UniversalPolicy]:
        """Return the policy at each checkpoint. It takes observation and context."""
        contexts = contexts_of(data)
        told = contexts.astype(np.float32)[data.variant_index]
        seen = np.concatenate((data.observations, told), axis=1)
        following = np.concatenate((data.next_observations, told), axis=1)
        actors = self._algorithm.train(replace(data, observations=seen, next_observations=following))
        robot, low, high = data.table[0].robot, contexts.min(axis=0), contexts.max(axis=0)
        return {updates: UniversalPolicy(robot, actor, low, high, {}) for updates, actor in actors.items()}


ALGORITHMS: Mapping[str, NewAlgorithm] = {
    "bc": Cloning,
    "bc-10%": partial(Cloning, best=0.1),
    "td3+bc": Td3Bc,
    "iql": Iql,
}
ACROSS_ALGORITHMS: Mapping[str, NewAlgorithm] = {
    "bc": Cloning,
    "iql": Iql,
    "bc-told": partial(Told, Cloning),
    "iql-told": partial(Told, Iql),
}


@dataclass(frozen=True)
class OfflineGrid:
    """The cells of a run: all combinations of these methods, robots, tiers and seeds.

    Attributes:
        methods: maps names to algorithms.
        robots: the robots.
        tiers: tiers of the datasets.
        seeds: seeds of the algorithms.
        updates: number of updates. Policies after those of the protocol's numbers that are smaller are
            evaluated too.
        episodes: number of episodes of each evaluation.
        across: learn from all training variants of the robot's random split instead of from its base.
    """

    methods: Mapping[str, NewAlgorithm] = field(default_factory=lambda: ALGORITHMS)
    robots: Sequence[str] = ROBOTS
    tiers: Sequence[str] = TIERS
    seeds: Sequence[int] = tuple(range(SEEDS))
    updates: int = UPDATES
    episodes: int = EVALUATION_EPISODES
    across: bool = False

    __repr__ = short_repr

    def __post_init__(self) -> None:
        tiers = (SHIFTED_TIER,) if self.across else ALL_TIERS
        for word, given, valid in (("robot", self.robots, ROBOTS), ("tier", self.tiers, tiers)):
            unknown = sorted(set(given) - set(valid))
            if unknown:
                raise BenchmarkChoiceError(f"no {word} {unknown[0]!r} here; valid: {', '.join(valid)}")

    def cells(self) -> int:
        """Return the number of cells."""
        return len(self.methods) * len(self.robots) * len(self.tiers) * len(self.seeds)

    def checkpoints(self) -> list[int]:
        """Return the numbers of updates after which a policy is evaluated."""
        return [*(number for number in CHECKPOINTS if number < self.updates), self.updates]

    def seconds(self) -> float:
        """Return about how long one process computes the cells."""
        each = sum(SECONDS_PER_UPDATE.get(name, 0.0) for name in self.methods) * self.updates
        return self.cells() / len(self.methods) * each

    def variants(self, robot: str, tier: str) -> tuple[list[Variant], list[Variant]]:
        """Return the variants whose data a cell learns from, and those that it is evaluated on."""
        if self.across:
            split = held_out(ACROSS_SPLIT.format(robot))
            return list(map(Variant.parse, split.train)), list(map(Variant.parse, split.test))
        shifted = map(Variant.parse, SHIFTED_VARIANTS if tier == SHIFTED_TIER else ())
        return [Variant(robot)], [Variant(robot), *(each for each in shifted if each.robot == robot)]

    def recipes(self) -> list[Recipe]:
        """Return the recipes of the datasets that the cells need."""
        recipes: list[Recipe] = []
        for robot, tier in product(self.robots, self.tiers):
            episodes = LARGE_EPISODES if tier in LARGE_TIERS else EPISODES
            sampled = tier in SAMPLED_TIERS
            learnt, _ = self.variants(robot, tier)
            recipes += [Recipe(variant, tier, episodes, stochastic=sampled) for variant in learnt]
        return recipes


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
        results: folder of ``offline.jsonl`` and ``across.jsonl``.
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
    file = results / (ACROSS_FILE if grid.across else FILE)
    trained = {_without_experts(line): line for line in read_lines(file)}
    return run_lines(file, partial(_compute, grid, trained, jobs), list(_lines(grid)), on_cells)


def _lines(grid: OfflineGrid) -> Iterator[Line]:
    # All cells of a dataset share its digest, and all cells share the versions.
    digest, present = cache(data_sha256), versions()
    for seed, robot, tier in product(grid.seeds, grid.robots, grid.tiers):
        learnt, acted_in = grid.variants(robot, tier)
        for name, new in grid.methods.items():
            yield {
                "protocol": ACROSS if grid.across else NAME,
                "method": name,
                "settings": algorithm_settings(new),
                "robot": robot,
                "tier": tier,
                "seed": seed,
                "checkpoints": grid.checkpoints(),
                "episodes": grid.episodes,
                "variants": [str(variant) for variant in acted_in],
                "data_sha256": digest(tuple(variant.dataset_id(tier) for variant in learnt)),
                "policies_sha256": policies_sha256(tuple(acted_in)),
                "versions": present,
            }


def _compute(
    grid: OfflineGrid, trained: Mapping[str, Line], jobs: int, lines: Sequence[Line]
) -> Iterator[Line]:
    """Yield the lines with their measured entries.

    Where only the experts have changed since a line was trained, only the references change.
    """
    for line in lines:
        if before := trained.get(_without_experts(line)):
            yield {**before, **line, "references": _references(line)}
    others = [line for line in lines if _without_experts(line) not in trained]
    yield from measure_each(partial(_run_cell, grid), jobs, others)


def _without_experts(line: Line) -> str:
    return identity({key: line[key] for key in line if key != "policies_sha256"})


def _references(line: Line) -> dict[str, list[float]]:
    return {variant: references(Variant.parse(variant)) for variant in line["variants"]}


def _check_sampled(recipe: Recipe) -> None:
    """Raise a BenchmarkError if a dataset needs sampled actions but has the policies' modes."""
    metadata = read_metadata(minari_root.dataset_folder(recipe.dataset_id) / "data")
    if recipe.stochastic and metadata.get("policy_deterministic"):
        raise BenchmarkError(
            f"{recipe.dataset_id} has deterministic actions, but {NAME} needs sampled ones: replace it with "
            f"`imujoco publish {recipe.variant} --tier {recipe.tier} --stochastic --force`"
        )


def _run_cell(grid: OfflineGrid, line: Line) -> Line:
    start = _seconds()
    learnt, acted_in = grid.variants(line["robot"], line["tier"])
    data = arrays([variant.dataset_id(line["tier"]) for variant in learnt], dtype=np.float32)
    policies = grid.methods[line["method"]](line["seed"], tuple(line["checkpoints"])).train(data)
    training = _seconds() - start
    found: dict[str, dict[str, Any]] = {}
    with named(line):
        if not isinstance(policies, Mapping) or sorted(policies) != line["checkpoints"]:
            wanted = ", ".join(map(str, line["checkpoints"]))
            raise BenchmarkError(f"train() must return a policy after each of these updates: {wanted}")
        for variant, (updates, policy) in product(acted_in, policies.items()):
            own = policy.fold(variant) if isinstance(policy, UniversalPolicy) else policy
            returns = episode_returns(own, variant, line["episodes"])
            found.setdefault(str(variant), {})[str(updates)] = {"returns": returns}
    return {
        **line,
        "references": _references(line),
        "results": found,
        "seconds": [round(training, 1), round(_seconds() - start - training, 1)],
    }


def _seconds() -> float:
    """Return the processor time of this process and of those that it has waited for."""
    return sum(os.times()[:4])


def algorithm_settings(new: NewAlgorithm) -> dict[str, Any]:
    """Return the settings of an algorithm, for its lines: all but the seed and the checkpoints."""
    settings = settings_of(new(0, ()))
    settings.pop("checkpoints", None)
    return settings
