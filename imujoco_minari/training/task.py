"""The description of a training run: variants, hyperparameters, seed, start and target."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from imujoco_minari.policies import Array
from imujoco_minari.training.hyperparameters import SCRATCH, Hyperparameters
from imujoco_minari.variants import Variant

# A weak variant is chosen up to six times as often as one that does well.
_WEIGHTS = (0.1, 0.6)


@dataclass(frozen=True)
class Distribution:
    """The variants that a universal policy is trained in.

    Attributes:
        listed: the variants that evaluate it -> the return that counts as 1 in each.
        draw: a seed -> another variant to train in.
        drawn: share of the episodes whose variant is drawn.
    """

    listed: Mapping[Variant, float]
    draw: Callable[[int], Variant]
    drawn: float = 0.1

    def choose(self, rng: np.random.Generator, seed: int, running: Mapping[str, float]) -> Variant:
        """Return the variant of an episode.

        Args:
            rng: source of the choice.
            seed: of a drawn variant.
            running: variant -> running share of its training episodes. Weak variants come more often.
        """
        if rng.random() < self.drawn:
            return self.draw(seed)
        variants = list(self.listed)
        shares = np.array([running.get(str(each), 0.8) for each in variants])
        weights = np.clip(1.1 - shares, *_WEIGHTS)
        return variants[int(rng.choice(len(variants), p=weights / weights.sum()))]


@dataclass(frozen=True)
class Task:
    """The description of a training run.

    Attributes:
        variant: the variant to train in; the base for a universal policy.
        settings: the hyperparameters.
        seed: seed of all that is random.
        start: name of the agent that the run starts from, or ``scratch``.
        agent: the arrays of that agent; empty from scratch.
        start_sha256: digest of that agent's actor, from its record.
        start_told: the variant that the universal policy is told, where the run starts from it.
        target: the run stops when an actor's evaluation over the deciding episodes has this score.
        over: the variants of a universal policy, which is told the variant; None for the variant alone.
    """

    variant: Variant
    settings: Hyperparameters
    seed: int = 0
    start: str = SCRATCH
    agent: dict[str, Array] = field(default_factory=dict, repr=False)
    start_sha256: str = ""
    start_told: str = ""
    target: float = float("inf")
    over: Distribution | None = None
