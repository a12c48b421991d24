"""The few-shot methods by name, their interface, and the bounds.

A method is a class with ``fit`` and ``adapt``. Yours needs nothing else to be run beside those of
this package: see :func:`~imujoco_minari.benchmark.few_shot.run_few_shot`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from inspect import signature
from typing import Any, Protocol

import numpy as np

from imujoco_minari.benchmark.cloning import BaseExpert, MultiVariant, Scratch
from imujoco_minari.benchmark.history import History
from imujoco_minari.benchmark.meta import Maml, SetEncoder
from imujoco_minari.errors import BenchmarkChoiceError, BenchmarkError, clipped, unknown
from imujoco_minari.loading import Arrays
from imujoco_minari.policies import Actor, expert_actor, random_policy, universal_policy
from imujoco_minari.variants import ROBOTS, Variant


class Method(Protocol):
    """Adapts to the demonstrations of a held-out variant.

    A method that learns from the training variants first has a second method, ``fit(train)``. It gets the
    :class:`~imujoco_minari.loading.Arrays` of all training variants.
    """

    def adapt(self, demonstrations: Arrays) -> Any:
        """Return a policy for the variant of the demonstrations.

        Called many times after ``fit``; one call must not change the result of another.

        Args:
            demonstrations: some steps of one variant; each window is an episode.

        Returns:
            A policy that :func:`imujoco_minari.evaluate` takes, or a mapping from the number of gradient
            steps to the policy after them.
        """


# Returns a new method for a seed.
NewMethod = Callable[[int], Method]


@dataclass
class Bound:
    """A bound: a policy of the held-out variant that depends on neither demonstrations nor seed."""

    seed: int
    policy_of: Callable[[Variant], Any] = field(repr=False)

    def adapt(self, demonstrations: Arrays) -> Any:
        """Return the policy."""
        return self.policy_of(Variant.parse(demonstrations.table[0].variant))


@dataclass
class UniversalBound:
    """What knowing the body is worth: the robot's universal policy, which is told the body.

    It was trained online, in many variants, the held-out ones among them. No method has that.
    """

    seed: int
    policies: tuple[str, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        found = {robot: universal_policy(robot) for robot in ROBOTS}
        self.policies = tuple(f"{robot} {policy.sha256}" for robot, policy in found.items() if policy)

    def adapt(self, demonstrations: Arrays) -> Actor:
        """Return the universal policy, told the variant."""
        variant = Variant.parse(demonstrations.table[0].variant)
        if (policy := universal_policy(variant.robot)) is None:
            raise BenchmarkError(f"{variant.robot} has no universal policy")
        return policy.fold(variant)


METHODS: Mapping[str, NewMethod] = {
    "scratch": Scratch,
    "base-expert": BaseExpert,
    "multi-variant": MultiVariant,
    "maml": Maml,
    "set-encoder": SetEncoder,
    "history": History,
    "told": partial(MultiVariant, told=True),
    "universal": UniversalBound,
    "random": partial(Bound, policy_of=lambda variant: random_policy(variant.robot)),
    "expert": partial(Bound, policy_of=expert_actor),
}
# The policies of these methods do not depend on the demonstrations. They run with one budget.
COMPARISONS = ("told", "universal", "random", "expert")
# The bounds: these train nothing.
BOUNDS = ("universal", "random", "expert")


def find_method(name: str, known: Mapping[str, Any] = METHODS, does: str = "adapt(demonstrations)") -> Any:
    """Return the method or algorithm of a name, or the class that ``module:Class`` names.

    Raises:
        BenchmarkChoiceError: if neither exists, or the class does not have what it ``does``.
    """
    module, _, own = name.partition(":")
    if own:
        try:
            found = getattr(import_module(module), own)
            if not isinstance(found, type):
                raise TypeError(f"{own} is not a class")
            if not callable(getattr(found, does.partition("(")[0], None)):
                raise TypeError(f"{own} has no method {does}")
            return found
        except (ImportError, AttributeError, TypeError, ValueError) as error:
            raise BenchmarkChoiceError(f"no method {clipped(name)!r}: {error}") from None
    if name not in known:
        raise BenchmarkChoiceError(f"{unknown('no method', name, known)}, or <module>:<Class> for your own")
    return known[name]


def with_settings(new: NewMethod, settings: Sequence[str]) -> NewMethod:
    """Return a method with other settings, which are texts such as ``rate=0.001``.

    Raises:
        BenchmarkChoiceError: if the method has no such setting.
        BenchmarkError: if the value is not a number, or not a whole one where the method has one.
    """
    arguments = signature(new).parameters
    numbers = {
        name: value
        for name, value in settings_of(new(0)).items()
        if type(value) in (int, float) and name in arguments
    }
    changed = {}
    for text in settings:
        name, _, value = text.partition("=")
        if name not in numbers:
            raise BenchmarkChoiceError(f"no setting {clipped(text)!r}; valid: {', '.join(numbers) or 'none'}")
        kind = type(numbers[name])
        try:
            changed[name] = kind(value)
            valid = 0 <= changed[name] < math.inf
        except ValueError:
            valid = False
        if not valid:
            whole = "whole" if kind is int else "finite"
            raise BenchmarkError(f"{clipped(text)!r} is not a {whole} number from 0")
    return partial(new, **changed)


def settings_of(method: object) -> dict[str, Any]:
    """Return the settings of a new method, for its lines: its attributes of plain values and sequences."""
    found = {}
    for name, value in vars(method).items():
        if name != "seed" and not name.startswith("_"):
            values = value if isinstance(value, list | tuple) else [value]
            plain = [each.item() if isinstance(each, np.generic) else each for each in values]
            if all(isinstance(each, bool | int | float | str) for each in plain):
                found[name] = plain if values is value else plain[0]
    return found
