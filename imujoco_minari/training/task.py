"""The description of a training run: variant, hyperparameters, seed, start and target."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym

from imujoco_minari.envs.registration import make
from imujoco_minari.policies import Array
from imujoco_minari.training.hyperparameters import SCRATCH, Hyperparameters
from imujoco_minari.variants import Variant


@dataclass(frozen=True)
class Task:
    """The description of a training run.

    Attributes:
        variant: the variant to train in.
        settings: the hyperparameters.
        seed: seed of all that is random.
        start: name of the agent that the run starts from, or ``scratch``.
        agent: the arrays of that agent; empty from scratch.
        start_sha256: digest of that agent's actor, from its record.
        target: the run stops when an actor's evaluation over the deciding episodes has this score.
        purpose: the reason for a run that trains no expert, for messages; empty for an expert's run.
    """

    variant: Variant
    settings: Hyperparameters
    seed: int = 0
    start: str = SCRATCH
    agent: dict[str, Array] = field(default_factory=dict, repr=False)
    start_sha256: str = ""
    target: float = float("inf")
    purpose: str = ""

    def environment(self) -> gym.Env[Any, Any]:
        """Return a new environment of the variant."""
        return make(self.variant, disable_env_checker=True)
