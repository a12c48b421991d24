"""The few-shot methods by name, their interface, and the bounds.

A method is a class with ``fit`` and ``adapt``. Yours needs nothing else to be run beside those of
this package: see :func:`~imujoco_minari.benchmark.few_shot.run_few_shot`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, Protocol

from imujoco_minari.benchmark.cloning import BaseExpert, MultiVariant, Scratch
from imujoco_minari.benchmark.maml import Maml
from imujoco_minari.benchmark.set_encoder import SetEncoder
from imujoco_minari.errors import BenchmarkChoiceError, BenchmarkError, clipped, suggestion
from imujoco_minari.loading import Arrays
from imujoco_minari.policies import Actor, RandomPolicy, expert_actor, random_policy
from imujoco_minari.variants import Variant


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
class RandomBound:
    """The lower bound: random actions."""

    seed: int

    def adapt(self, demonstrations: Arrays) -> RandomPolicy:
        """Return the random policy."""
        return random_policy(demonstrations.table[0].robot)


@dataclass
class ExpertBound:
    """The upper bound: the expert of the held-out variant."""

    seed: int

    def adapt(self, demonstrations: Arrays) -> Actor:
        """Return the variant's expert."""
        return expert_actor(Variant.parse(demonstrations.table[0].variant))


METHODS: Mapping[str, NewMethod] = {
    "scratch": Scratch,
    "base-expert": BaseExpert,
    "multi-variant": MultiVariant,
    "maml": Maml,
    "set-encoder": SetEncoder,
    "told": partial(MultiVariant, told=True),
    "random": RandomBound,
    "expert": ExpertBound,
}
# The policies of these methods do not depend on the demonstrations. They run with one budget.
COMPARISONS = ("told", "random", "expert")
# The bounds of the scores: these two train nothing.
BOUNDS = ("random", "expert")


def find_method(name: str) -> NewMethod:
    """Return the method of a name, or the class that ``module:Class`` names.

    Raises:
        BenchmarkChoiceError: if neither exists.
    """
    module, _, own = name.partition(":")
    if own:
        try:
            found: NewMethod = getattr(import_module(module), own)
            return found
        except (ImportError, AttributeError, ValueError) as error:
            raise BenchmarkChoiceError(f"no method {clipped(name)!r}: {error}") from None
    if name not in METHODS:
        raise BenchmarkChoiceError(
            f"no method {clipped(name)!r}{suggestion(name[:80], METHODS)}; valid: {', '.join(METHODS)}, or "
            "<module>:<Class> for your own"
        )
    return METHODS[name]


def with_settings(new: NewMethod, settings: Sequence[str]) -> NewMethod:
    """Return a method with other settings.

    Args:
        new: the method.
        settings: texts such as ``rate=0.001``.

    Raises:
        BenchmarkChoiceError: if the method has no such setting.
        BenchmarkError: if the value is not a number.
    """
    changed = {}
    for text in settings:
        name, _, value = text.partition("=")
        present = settings_of(new(0))
        valid = [name for name, number in present.items() if type(number) in (int, float)]
        if name not in valid:
            raise BenchmarkChoiceError(f"no setting {clipped(text)!r}; valid: {', '.join(valid) or 'none'}")
        try:
            changed[name] = type(present[name])(value)
        except ValueError:
            raise BenchmarkError(f"{clipped(text)!r} is not a number") from None
    return partial(new, **changed)


def settings_of(method: object) -> dict[str, Any]:
    """Return the settings of a new method, for its lines: its attributes that are plain values or tuples."""
    plain = (bool, int, float, str, tuple)
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in vars(method).items()
        if isinstance(value, plain) and name != "seed" and not name.startswith("_")
    }
