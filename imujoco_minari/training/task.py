"""The settings of a sweep, and the description of a training run: variants, settings, start and target."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.policies import Array, policies_folder
from imujoco_minari.training.hyperparameters import SCRATCH, Hyperparameters
from imujoco_minari.variants import Variant

# Share of the episodes whose variant is drawn.
_DRAWN = 0.1
# A weak variant is chosen up to six times as often as one that does well.
_WEIGHTS = (0.1, 0.6)


def default_state() -> Path:
    """Return the default folder of unfinished runs, beside the user's policies."""
    return policies_folder().parent / "training"


@dataclass(frozen=True)
class Plan:
    """The settings of a sweep.

    Attributes:
        state: folder of the unfinished runs.
        policies: folder of finished policies.
        scratch: train variants from scratch too.
        seed: seed of all that is random.
        target: stop at this score, the mean of mean and lowest return; None for a share of the base expert's
            return.
        changes: hyperparameters that replace those of the file.
        nice: increase of the process's nice value.
        improve: continue the training of finished policies and keep the better ones.
        device: device of the updates: ``cpu``, ``gpu``, or None for JAX's default.
    """

    state: Path = field(default_factory=default_state)
    policies: Path = field(default_factory=policies_folder)
    scratch: bool = False
    seed: int = 0
    target: float | None = None
    changes: dict[str, int | float] = field(default_factory=dict)
    nice: int = 0
    improve: bool = False
    device: str | None = None


@dataclass(frozen=True)
class Distribution:
    """The variants that a universal policy is trained in.

    Attributes:
        listed: the variants that evaluate it.
        expert: record of the base's expert. Its return counts as 1 in every variant.
        draw: a seed -> another variant to train in.
    """

    listed: Sequence[Variant]
    expert: Mapping[str, Any]
    draw: Callable[[int], Variant]

    def choose(self, rng: np.random.Generator, seed: int, running: Mapping[str, float]) -> Variant:
        """Return the variant of an episode, which ``seed`` draws or ``rng`` chooses among the listed ones.

        ``running`` maps variants to shares of their training episodes. Weak variants come more often.
        """
        if rng.random() < _DRAWN:
            return self.draw(seed)
        shares = np.array([running.get(str(each), 0.8) for each in self.listed])
        weights = np.clip(1.1 - shares, *_WEIGHTS)
        return self.listed[int(rng.choice(len(self.listed), p=weights / weights.sum()))]


@dataclass
class Start:
    """The agent that a run starts from.

    Attributes:
        name: a base, ``universal policy`` or ``scratch``.
        agent: its arrays; empty from scratch.
        sha256: digest of its policy, from its record.
        told: what the universal policy is told: a variant or a searched context; empty for a base's agent.
        score: score of its evaluation on the variant; -inf if not evaluated.
    """

    name: str = SCRATCH
    agent: dict[str, Array] = field(default_factory=dict, repr=False)
    sha256: str = ""
    told: str = ""
    score: float = float("-inf")


@dataclass(frozen=True)
class Task:
    """The description of a training run.

    Attributes:
        variant: the variant to train in; the base for a universal policy.
        settings: the hyperparameters.
        seed: seed of all that is random.
        start: the agent that the run starts from.
        target: the run stops when an actor's evaluation over the deciding episodes has this score.
        over: the variants of a universal policy, which is told the variant; None for the variant alone.
    """

    variant: Variant
    settings: Hyperparameters
    seed: int = 0
    start: Start = field(default_factory=Start)
    target: float = float("inf")
    over: Distribution | None = None
