"""Few-shot imitation: the cells of the benchmark, and how they run.

A cell is a pure function of method, split, tier, variant, budget and seed, and of the digests and versions
that its line states.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import groupby, product
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.benchmark import protocol
from imujoco_minari.benchmark.lines import (
    Line,
    data_sha256,
    named,
    policies_sha256,
    references,
    run_lines,
    versions,
)
from imujoco_minari.benchmark.methods import COMPARISONS, Method, NewMethod, settings_of
from imujoco_minari.benchmark.protocol import Budget, draw_demonstrations, episode_returns, relative_error
from imujoco_minari.errors import BenchmarkChoiceError, BenchmarkError, JobError
from imujoco_minari.loading import arrays
from imujoco_minari.parallel import run_jobs
from imujoco_minari.short_repr import short_repr
from imujoco_minari.variants import EXPERT, HeldOut, Variant

FILE = "few-shot.jsonl"
# The attributes that name a cell. A line adds settings, digests and versions.
CELL = ("protocol", "method", "split", "tier", "train_tier", "variant", "budget", "seed")

# Processor time of one core.
SECONDS_PER_CELL = {"set-encoder": 0.9, "history": 12.0} | dict.fromkeys(COMPARISONS, 0.9)
SECONDS_PER_ADAPTED_CELL = 3.9
SECONDS_PER_FIT = {"multi-variant": 14.0, "told": 15.0, "maml": 29.0, "set-encoder": 24.0, "history": 31.0}


@dataclass(frozen=True)
class FewShotGrid:
    """The cells of a run: all combinations of these methods, splits, tiers, budgets, seeds and variants.

    Attributes:
        methods: maps names to methods.
        splits: the splits; each is within one robot.
        tiers: tiers of the training data, and of the demonstrations.
        budgets: how much of a held-out variant is demonstrated; None for those of the protocol.
        seeds: seeds of the draws and of the methods.
        variants: ids of the held-out variants to use; None for all of a split.
        episodes: number of episodes of each evaluation.
        demonstrations: another tier of the demonstrations, for example of other experts.
    """

    methods: Mapping[str, NewMethod]
    splits: Sequence[HeldOut]
    tiers: Sequence[str] = (EXPERT,)
    budgets: Sequence[Budget] | None = None
    seeds: Sequence[int] = tuple(range(protocol.SEEDS))
    variants: Sequence[str] | None = None
    episodes: int = protocol.EVALUATION_EPISODES
    demonstrations: str | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        held_out = {variant for split in self.splits for variant in split.test}
        unknown = sorted(set(self.variants or ()) - held_out)
        if unknown:
            raise BenchmarkChoiceError(f"{unknown[0]} is not held out; valid: {', '.join(sorted(held_out))}")
        for split in self.splits:
            if len(split.robots) > 1:
                found = ", ".join(split.robots)
                raise BenchmarkChoiceError(f"{split.name} has several robots ({found}); valid: splits of one")

    def held_out(self, split: HeldOut) -> list[str]:
        """Return the held-out variants of a split that are in the grid."""
        return [variant for variant in split.test if self.variants is None or variant in self.variants]

    def budgets_of(self, method: str, split: HeldOut) -> Sequence[Budget]:
        """Return the budgets of a method in a split. A comparison needs no demonstrations, so it has one."""
        if method in COMPARISONS:
            return protocol.BUDGETS[:1]
        return self.budgets or protocol.budgets_of(split)

    def cells(self) -> int:
        """Return the number of cells."""
        return sum(self._cells(name) for name in self.methods)

    def seconds(self) -> float:
        """Return about how long one process computes the cells."""
        fits = sum(SECONDS_PER_FIT.get(name, 0.0) for name in self.methods)
        cells = sum(
            self._cells(name) * SECONDS_PER_CELL.get(name, SECONDS_PER_ADAPTED_CELL) for name in self.methods
        )
        return cells + fits * len(self.splits) * len(self.tiers) * len(self.seeds)

    def _cells(self, method: str) -> int:
        cells = sum(len(self.held_out(split)) * len(self.budgets_of(method, split)) for split in self.splits)
        return cells * len(self.tiers) * len(self.seeds)

    def dataset_ids(self) -> list[str]:
        """Return the ids of the datasets that the cells need."""
        learns = any(hasattr(new(0), "fit") for new in self.methods.values())
        wanted: list[str] = []
        for split, tier in product(self.splits, self.tiers):
            wanted += datasets_of(split.train if learns else (), tier)
            wanted += datasets_of(self.held_out(split), self.demonstrations or tier)
        return list(dict.fromkeys(wanted))


def run_few_shot(
    grid: FewShotGrid,
    results: Path,
    *,
    jobs: int = 1,
    on_cells: Callable[[int], None] = lambda cells: None,
) -> list[Line]:
    """Compute the cells of a grid that a results folder lacks, and return the lines of all of them.

    Each line is written as soon as it is known, so a killed run continues where it stopped.

    Args:
        grid: the cells.
        results: folder of ``few-shot.jsonl``.
        jobs: number of processes. The results do not depend on it.
        on_cells: called with the number of cells that have become known.

    Raises:
        DatasetNotFoundError: if a dataset is not in the Minari root.
        BenchmarkError: if a variant has no expert, or a process was lost.
        StorageError: if a line cannot be written.

    Example:
        >>> grid = FewShotGrid({"mine": MyMethod}, [held_out("hopper-random-v1")])  # doctest: +SKIP
        >>> lines = run_few_shot(grid, Path("results"))  # doctest: +SKIP
    """
    return run_lines(results / FILE, partial(_compute, grid, jobs), list(_lines(grid)), on_cells)


def _lines(grid: FewShotGrid) -> Iterator[Line]:
    """Yield a line for each cell, without its measured entries."""
    # All cells of a dataset share its digest.
    digest = cache(data_sha256)
    stated = {"protocol": protocol.NAME, "episodes": grid.episodes, "versions": versions()}
    for split, train_tier, seed in product(grid.splits, grid.tiers, grid.seeds):
        tier = grid.demonstrations or train_tier
        for name, new in grid.methods.items():
            method = new(seed)
            common = {
                **stated,
                "method": name,
                "settings": settings_of(method),
                "split": split.name,
                "tier": tier,
                **({"train_tier": train_tier} if tier != train_tier else {}),
                "seed": seed,
                "train_sha256": "",
            }
            if hasattr(method, "fit"):
                common["train_sha256"] = digest(datasets_of(split.train, train_tier))
            budgets = grid.budgets_of(name, split)
            for variant in map(Variant.parse, grid.held_out(split)):
                own = {
                    **common,
                    "variant": str(variant),
                    "data_sha256": digest((variant.dataset_id(tier),)),
                    "policies_sha256": policies_sha256((variant.base, variant)),
                }
                yield from ({**own, "budget": str(budget)} for budget in budgets)


def datasets_of(variants: Iterable[str], tier: str) -> tuple[str, ...]:
    """Return the ids of the datasets of variants."""
    return tuple(Variant.parse(variant).dataset_id(tier) for variant in variants)


def _compute(grid: FewShotGrid, jobs: int, lines: Sequence[Line]) -> Iterator[Line]:
    """Yield the lines with their measured entries."""
    splits = {split.name: split for split in grid.splits}
    # Methods are fitted shortly before they are used, so that a killed run loses little.
    for (split, tier, seed), own in groupby(lines, lambda x: (x["split"], train_tier(x), x["seed"])):
        tasks = [list(task) for _, task in groupby(own, itemgetter("method", "variant"))]
        train = datasets_of(splits[split].train, tier)
        names = list(dict.fromkeys(task[0]["method"] for task in tasks))
        fits = [(grid.methods[name], seed, train) for name in names]
        fitted = {
            names[number]: _found(fit, names[number]) for number, fit in run_jobs(_fit, fits, jobs=jobs)
        }
        work = [(fitted[task[0]["method"]], task) for task in tasks]
        for number, found in run_jobs(_run_task, work, jobs=jobs):
            yield from _found(found, _dataset_id(tasks[number]))


def train_tier(line: Line) -> str:
    """Return the tier of the training data of a line."""
    return str(line.get("train_tier", line["tier"]))


def _found(result: Any, name: str) -> Any:
    if isinstance(result, JobError):
        raise BenchmarkError(f"{name}: {result}")
    return result


def _fit(work: tuple[NewMethod, int, tuple[str, ...]]) -> Method:
    new, seed, train = work
    method = new(seed)
    if hasattr(method, "fit"):
        method.fit(arrays(list(train), portion=(0.0, protocol.TRAIN_SHARE), dtype=np.float32))
    return method


def _run_task(work: tuple[Method, list[Line]]) -> list[Line]:
    """Return the lines of one method, seed and variant, with their measured entries."""
    method, task = work
    variant, data = Variant.parse(task[0]["variant"]), arrays(_dataset_id(task), dtype=np.float32)
    evaluated: dict[str | None, list[float]] = {}
    lines: list[Line] = []
    for line in task:
        demonstrations, query = draw_demonstrations(data, Budget.parse(line["budget"]), line["seed"])
        start = time.process_time()
        adapted = method.adapt(demonstrations)
        adapting = time.process_time() - start
        found = {}
        with named(line):
            for steps, policy in _by_steps(adapted).items():
                # Several budgets share the policy after 0 steps.
                digest = getattr(policy, "sha256", None)
                returns = evaluated.get(digest) or episode_returns(policy, variant, line["episodes"])
                if digest is not None:
                    evaluated[digest] = returns
                found[str(steps)] = {"returns": returns, "error": relative_error(policy, query)}
        seconds = [round(adapting, 2), round(time.process_time() - start - adapting, 2)]
        lines.append({**line, "references": references(variant), "results": found, "seconds": seconds})
    return lines


def _by_steps(adapted: Any) -> Mapping[int, Any]:
    """Return what ``adapt`` returned as policies by their numbers of gradient steps."""
    policies = adapted if isinstance(adapted, Mapping) else {0: adapted}
    if not policies or not all(isinstance(steps, int | np.integer) and steps >= 0 for steps in policies):
        found = ", ".join(map(repr, policies)) or "none"
        raise BenchmarkError(
            f"adapt() returned policies after these steps: {found}; valid: whole numbers from 0"
        )
    return policies


def _dataset_id(task: Sequence[Line]) -> str:
    return Variant.parse(task[0]["variant"]).dataset_id(task[0]["tier"])
