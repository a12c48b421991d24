"""Hyperparameters as data: ``hyperparameters.toml`` gives a reason for each; a robot's page may differ."""

from __future__ import annotations

import tomllib
from dataclasses import asdict, dataclass, fields
from functools import cache
from importlib import resources
from typing import Any

from imujoco_minari.errors import CatalogueError
from imujoco_minari.variants import specification

SCRATCH, FAR, WARM, NEAR, GENERALIST, IMPROVE = "scratch", "far", "warm", "near", "generalist", "improve"


@dataclass(frozen=True)
class Hyperparameters:
    """What decides a training run, beside variant, start and seed.

    Attributes:
        algorithm: the name that records and datasets state.
        critic_width: units in each of a critic's two hidden layers.
        steps_per_call: environment steps between two calls of the update loop.
        updates_per_call: gradient steps in each call.
        policy_delay: updates of the critics for each of the actor.
        batch_size: transitions an update.
        learning_rate: of actor, critics and entropy coefficient.
        settling_rate: the learning rate of the last steps.
        settling_steps: how many those are.
        stones: milder variants that the run first trains in, one after the other (stepping stones).
        approach_share: share of the run's steps that those take together.
        gamma: discount factor.
        exploration_steps: steps before the first update, random or of the loaded policy.
        evaluate_every: steps between two evaluations, which are also the checkpoints.
        max_steps: where a run ends that has not reached its target.
        ranking_episodes: episodes of each evaluation.
        choosing_episodes: episodes of a second look at evaluations that rank high.
        deciding_episodes: episodes of a third look at those that seem better than the best.
        confirming_episodes: episodes of the final evaluation, on seeds of its own.
    """

    algorithm: str
    critic_width: int
    steps_per_call: int
    updates_per_call: int
    policy_delay: int
    batch_size: int
    learning_rate: float
    settling_rate: float
    settling_steps: int
    stones: int
    approach_share: float
    gamma: float
    exploration_steps: int
    evaluate_every: int
    max_steps: int
    ranking_episodes: int
    choosing_episodes: int
    deciding_episodes: int
    confirming_episodes: int

    def rate(self, steps: int) -> float:
        """Return the learning rate after so many environment steps."""
        settling = steps >= self.max_steps - self.settling_steps
        return self.settling_rate if settling else self.learning_rate

    def asdict(self) -> dict[str, Any]:
        """Return the fields as a dict for JSON."""
        return asdict(self)


def hyperparameters(robot: str, start: str, **changes: Any) -> Hyperparameters:
    """Return the hyperparameters for ``robot`` and ``start``, with ``changes``.

    Args:
        robot: its name.
        start: ``scratch``, ``warm`` (from another's agent), ``near`` and ``far`` (from another's that does
            nearly as well as is asked, or not half as well), ``generalist`` (another's, over all variants)
            or ``improve`` (its own).
        **changes: what differs from the file.

    Raises:
        CatalogueError: when a key is unknown.
    """
    table, own = _table(), specification(robot).training
    layers = (table["all"], table[start], own.get(start, {}), changes)
    values = {key: value for layer in layers for key, value in layer.items()}
    known = {field.name for field in fields(Hyperparameters)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise CatalogueError(f"unknown hyperparameter {unknown[0]!r}; valid: {', '.join(sorted(known))}")
    return Hyperparameters(**values)


@cache
def _table() -> dict[str, Any]:
    text = (resources.files("imujoco_minari.training") / "hyperparameters.toml").read_text("utf-8")
    return tomllib.loads(text)
