"""Hyperparameters by robot and start: ``hyperparameters.toml`` has the reasons, a robot's page may differ."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib import resources
from typing import Any, get_type_hints

from imujoco_minari.errors import CatalogueError, clipped, suggestion
from imujoco_minari.variants import specification
from imujoco_minari.variants.pages import STARTS

SCRATCH, WARM, NEAR, IMPROVE, UNIVERSAL = STARTS
_MAY_BE_ZERO = {"settling_rate", "settling_from", "exploration_steps", "critic_updates", "anchor", "momentum"}


@dataclass(frozen=True)
class Hyperparameters:
    """The settings of a training run, beside variant, start and seed.

    Attributes:
        critic_width: units in each of a critic's two hidden layers.
        lanes: environments that are stepped together.
        steps_per_call: environment steps between two calls of the update loop, a multiple of the lanes.
        updates_per_call: gradient steps in each call.
        policy_delay: critic updates per actor update.
        batch_size: transitions per update.
        buffer_size: transitions that are kept.
        learning_rate: learning rate of actor, critics and entropy coefficient.
        settling_rate: learning rate at the end. The rate falls to it by a cosine.
        settling_from: share of the steps after which the rate begins to fall.
        momentum: decay of Adam's mean of the gradients.
        anchor: how far the policy may go from the one that it began as; 0 does not hold it.
        average: share that the averaged weights keep at each of their updates, one in 50 calls.
        gamma: discount factor.
        search_generations: generations of the search of a context to tell the universal policy.
        exploration_steps: steps before the first update, by random actions or by the loaded policy.
        critic_updates: updates of the critics alone after them.
        evaluate_every: steps between two evaluations. Each evaluation is a checkpoint too.
        max_steps: number of steps after which a run ends without reaching its target.
        ranking_episodes: episodes of each evaluation.
        choosing_episodes: episodes of the second evaluation of an actor that ranks high.
        deciding_episodes: episodes of the third evaluation, of an actor that seems better than the best.
        confirming_episodes: episodes of the final evaluation, with seeds of its own.
    """

    critic_width: int
    lanes: int
    steps_per_call: int
    updates_per_call: int
    policy_delay: int
    batch_size: int
    buffer_size: int
    learning_rate: float
    settling_rate: float
    settling_from: float
    momentum: float
    anchor: float
    average: float
    gamma: float
    search_generations: int
    exploration_steps: int
    critic_updates: int
    evaluate_every: int
    max_steps: int
    ranking_episodes: int
    choosing_episodes: int
    deciding_episodes: int
    confirming_episodes: int

    def rate(self, steps: int) -> float:
        """Return the learning rate after ``steps`` environment steps."""
        done = min(1.0, steps / self.max_steps)
        if done <= self.settling_from:
            return self.learning_rate
        part = (done - self.settling_from) / (1 - self.settling_from)
        above = self.learning_rate - self.settling_rate
        return self.settling_rate + above * (1 + math.cos(math.pi * part)) / 2

    def asdict(self) -> dict[str, Any]:
        """Return the fields as a dict for JSON."""
        return asdict(self)


_TYPES = get_type_hints(Hyperparameters)


def hyperparameters(robot: str, start: str, **changes: Any) -> Hyperparameters:
    """Return the hyperparameters of a robot and a kind of start.

    Args:
        robot: name of the robot.
        start: ``scratch``; ``warm``, from an agent that is far from the target; ``near``, from one that
            nearly reaches it; ``improve``, from the policy's own agent; or ``universal``.
        **changes: values that replace those of the file.

    Raises:
        CatalogueError: if a key is unknown, or the robot's page has a value that it cannot have.

    Example:
        >>> hyperparameters("hopper", "warm").max_steps
        60000
    """
    table, own = _read_table(), specification(robot).training
    values = {**table["all"], **table[start], **own.get(start, {}), **changes}
    if unknown := sorted(set(values) - set(_TYPES)):
        raise CatalogueError(f"unknown hyperparameter {unknown[0]!r}; valid: {', '.join(sorted(_TYPES))}")
    for name, value in own.get(start, {}).items():
        if fault := _fault(name, value):
            raise CatalogueError(f"the page of {robot}, [training.{start}]: {fault}")
    return Hyperparameters(**values)


def hyperparameter_changes(texts: Sequence[str]) -> dict[str, int | float]:
    """Return the values that texts like ``batch_size=256`` set, each in the type of its hyperparameter.

    Raises:
        CatalogueError: if a text is no ``NAME=VALUE``, its name is unknown, or its value is no number
            that the hyperparameter can have.

    Example:
        >>> hyperparameter_changes(["batch_size=256", "gamma=0.98"])
        {'batch_size': 256, 'gamma': 0.98}
    """
    changes: dict[str, int | float] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or name not in _TYPES:
            near = "" if name in _TYPES else suggestion(name[:80], _TYPES)
            raise CatalogueError(
                f"cannot set {clipped(text)!r}{near}: write NAME=VALUE; names: {', '.join(sorted(_TYPES))}"
            )
        try:
            changes[name] = _TYPES[name](value)
        except ValueError:
            changes[name] = -1
        if fault := _fault(name, changes[name]):
            raise CatalogueError(f"cannot set {clipped(text)!r}: {fault}")
    return changes


def _fault(name: str, value: int | float) -> str:
    """Return what a hyperparameter must be, or an empty text if the value is valid."""
    whole, optional = _TYPES[name] is int, name in _MAY_BE_ZERO
    typed = isinstance(value, int) or not whole
    if typed and 0 <= value < math.inf and (value != 0 or optional):
        return ""
    return f"{name} is a {'whole number' if whole else 'number'} {'of at least 0' if optional else 'above 0'}"


@cache
def _read_table() -> dict[str, Any]:
    text = (resources.files("imujoco_minari.training") / "hyperparameters.toml").read_text("utf-8")
    return tomllib.loads(text)
