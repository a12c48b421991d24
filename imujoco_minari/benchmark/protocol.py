"""The protocol ``few-shot-v1``: how much is demonstrated, how long methods adapt, and what is evaluated.

A published protocol is never changed: a better one gets a new name. Every number of it is here.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imujoco_minari.errors import BenchmarkChoiceError, BenchmarkError, clipped, suggestion
from imujoco_minari.loading import STEP_ARRAYS, Arrays
from imujoco_minari.policies import LANES
from imujoco_minari.policies.adapters import batch_act
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.variants import HeldOut, Variant

NAME = "few-shot-v1"
# Gradient steps on the demonstrations. One training gives the policies of all of them.
STEPS = (0, 25, 200, 2000)
# Number of seeds, which are 0, 1, ...
SEEDS = 5
# Episodes of each evaluation, and their base seed. The demonstrations have other seeds.
EVALUATION_EPISODES, EVALUATION_SEED = 10, 2_000_003
# Share of each training variant's episodes that methods may use: 20 of 100. All would take gigabytes.
TRAIN_SHARE = 0.2
# Episodes on which the error of the actions is measured. They are never demonstrated.
QUERY_EPISODES = 10


@dataclass(frozen=True)
class Budget:
    """How much of a held-out variant is demonstrated.

    Attributes:
        count: number of windows, each from another episode.
        length: steps of a window; None for whole episodes.
    """

    count: int
    length: int | None = None

    @classmethod
    def parse(cls, text: str) -> Budget:
        """Return the budget that a text names, as ``5x100`` or ``1xall``.

        Raises:
            BenchmarkChoiceError: if it names none.
        """
        if found := re.fullmatch(r"0*([1-9]\d{0,8})x(?:0*([1-9]\d{0,8})|all)", text, re.ASCII):
            count, length = found.groups()
            return cls(int(count), int(length) if length else None)
        raise BenchmarkChoiceError(
            f"no budget {clipped(text)!r}; valid: <windows>x<steps>, as in 5x100, or 1xall for an episode"
        )

    def __str__(self) -> str:
        return f"{self.count}x{self.length or 'all'}"


BUDGETS = tuple(map(Budget.parse, ("1x100", "2x100", "5x100", "10x100", "1xall")))
# The extremes show which shifts are hard. The random splits, which are smaller, show how much data helps.
EXTREMES_BUDGETS = tuple(map(Budget.parse, ("5x100", "1xall")))


def budgets_of(split: HeldOut) -> tuple[Budget, ...]:
    """Return the budgets of a split of the protocol."""
    return EXTREMES_BUDGETS if "-extremes-" in split.name else BUDGETS


def validation_split(split: HeldOut) -> HeldOut:
    """Return a split of the training variants alone, on which settings of methods are chosen.

    Every fifth training variant is held out.
    """
    held = split.train[4::5]
    train = tuple(variant for variant in split.train if variant not in held)
    return HeldOut(f"{split.name}-validation", train, held, f"every fifth training variant of {split.name}")


def draw_demonstrations(data: Arrays, budget: Budget, seed: int) -> tuple[Arrays, Arrays]:
    """Return the demonstrations of a variant, and the episodes to measure the error of the actions on.

    Each window is of another episode. The first begins at its episode's start, the others anywhere. The
    smaller of two budgets with one length is part of the larger.

    Args:
        data: all episodes of the variant.
        budget: how much is demonstrated.
        seed: seed of the draw.

    Raises:
        BenchmarkError: if the variant has too few episodes.
    """
    variant = data.table[0].variant
    rng = np.random.default_rng([seed, *variant.encode()])
    order = rng.permutation(data.episodes)
    shares = rng.random(data.episodes)
    # Without the start of an episode, whether a policy falls at once is luck.
    shares[0] = 0.0
    if budget.count >= data.episodes:
        raise BenchmarkError(
            f"{variant} has {data.episodes} episodes; the budget {budget} needs {budget.count + 1}: "
            f"{budget.count} to demonstrate, and one to measure the error of the actions on"
        )
    chosen = data.select(order[: budget.count])
    query = data.select(order[max(budget.count, data.episodes - QUERY_EPISODES) :])
    if budget.length is None:
        return chosen, query
    spare = np.maximum(chosen.episode_lengths - budget.length, 0)
    first_rows = chosen.episode_starts + (shares[: budget.count] * (spare + 1)).astype(np.int64)
    lengths = np.minimum(chosen.episode_lengths, budget.length)
    starts = np.cumsum(lengths) - lengths
    rows = np.arange(lengths.sum()) + np.repeat(first_rows - starts, lengths)
    windows = {name: getattr(chosen, name)[rows] for name in STEP_ARRAYS}
    return replace(chosen, episode_starts=starts, **windows), query


def episode_returns(policy: Any, variant: Variant, episodes: int) -> list[float]:
    """Return the return of each of the first evaluation episodes of a policy on a variant."""
    found = evaluate(variant, policy, episodes=episodes, seed=EVALUATION_SEED)
    return [round(float(each), 2) for each in found.returns]


def relative_error(policy: Any, query: Arrays) -> float:
    """Return the norm of the errors of a policy's actions, divided by the norm of the data's actions."""
    if hasattr(policy, "actions_of"):
        # A policy with a memory needs the steps in order.
        actions = policy.actions_of(query)
    else:
        act, rows = batch_act(policy), query.observations
        rngs = [np.random.default_rng(i) for i in range(LANES)]
        blocks = [rows[start : start + LANES] for start in range(0, len(rows), LANES)]
        actions = np.concatenate([act(block, rngs[: len(block)]) for block in blocks])
    return round(float(np.linalg.norm(actions - query.actions) / np.linalg.norm(query.actions)), 4)


def holding_out(variants: Sequence[str], splits: Sequence[HeldOut]) -> list[HeldOut]:
    """Return the splits that hold variants out, with each variant in the first split that does.

    Raises:
        BenchmarkChoiceError: if no split holds one of them out.
    """
    found, left = [], list(dict.fromkeys(variants))
    for split in splits:
        held = tuple(variant for variant in left if variant in split.test)
        left = [variant for variant in left if variant not in held]
        if held:
            found.append(replace(split, test=held))
    if left:
        names = ", ".join(split.name for split in splits)
        near = suggestion(left[0], [variant for split in splits for variant in split.test])
        raise BenchmarkChoiceError(f"{left[0]} is held out in none of {names}{near}")
    return found
