"""Ranges of parameters, from which a seed draws a variant."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imujoco_minari.errors import DrawingError, VariantError, clipped, unknown
from imujoco_minari.short_repr import short_repr
from imujoco_minari.variants.changes import Change, plain_number
from imujoco_minari.variants.context import check_parameters
from imujoco_minari.variants.ids import BASE, EXPERT, Variant, full_id
from imujoco_minari.variants.pages import CATEGORIES
from imujoco_minari.variants.robots import carrying, specification

# The name of an environment or a dataset that draws from ranges.
RANDOMISED = "randomised"
UNIFORM, LOG_UNIFORM = "uniform", "log-uniform"
DISTRIBUTIONS = (UNIFORM, LOG_UNIFORM)
_NAME = re.compile(r"[a-z][a-z0-9]{0,39}", re.ASCII)
_TAKEN = (BASE, "all", *CATEGORIES)
_EXAMPLE = "mass/torsogeom"
# Percents to draw from where the catalogue lists none.
_UNLISTED = {
    "mass": (-50, 200),
    "joint": (-50, 0),
    "length": (-25, 50),
    "friction": (-50, 50),
    "gravity": (-50, 100),
    "gear": (-50, 100),
    "damping": (-50, 200),
    "armature": (-50, 200),
    "size": (-25, 50),
}


@dataclass(frozen=True)
class Ranges:
    """A robot with a range of percents for each of some parameters.

    Attributes:
        robot: the robot, as in ``hopper``.
        ranges: parameter -> lowest and highest percent, in the order of contexts. An argument may be in any
            order, and may hold lists and arrays.
        distribution: ``uniform`` draws the percent uniformly; ``log-uniform`` draws the logarithm of the
            factor 1 + percent / 100 uniformly.
        name: of a dataset that is collected from the ranges, in its id.

    Raises:
        VariantError: if there is no such robot or parameter, or a parameter cannot have such a percent.
        DrawingError: if there is no range, a range is not two numbers in order, there is no such
            distribution, or the name is not a word or has another meaning in ids.

    Example:
        >>> ranges = Ranges("hopper", {"mass/torsogeom": (-50, 100), "friction/feet": (-50, 50)})
        >>> str(ranges.draw(seed=0))
        'hopper-massinc_91p44_torsogeom-frictiondec_18p37_feet'
    """

    robot: str
    ranges: Mapping[str, Sequence[float]]
    distribution: str = UNIFORM
    name: str = RANDOMISED

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if not isinstance(self.ranges, Mapping) or not (names := check_parameters(self.robot, self.ranges)):
            raise DrawingError(
                f'no ranges are given; valid: parameter -> percents, as in {{"{_EXAMPLE}": (-50, 100)}}'
            )
        ordered = {name: _checked_range(self.robot, name, self.ranges[name]) for name in names}
        if self.distribution not in DISTRIBUTIONS:
            raise DrawingError(unknown("unknown distribution", self.distribution, DISTRIBUTIONS))
        if not isinstance(self.name, str) or not _NAME.fullmatch(self.name) or self.name in _TAKEN:
            raise DrawingError(
                f"the name of the ranges is {clipped(self.name)!r}; valid: a lower-case word, but not "
                f"{', '.join(_TAKEN)}"
            )
        object.__setattr__(self, "ranges", ordered)
        # A body and a group that has it cannot both be drawn.
        self.draw(0)

    def __reduce__(self) -> tuple[Callable[..., Ranges], tuple[Any, ...]]:
        return carrying(self.robot, Ranges, self.robot, self.ranges, self.distribution, self.name)

    @property
    def parameters(self) -> tuple[str, ...]:
        """The parameters that are drawn, in the order of contexts."""
        return tuple(self.ranges)

    @property
    def base(self) -> Variant:
        """The unchanged robot."""
        return Variant(self.robot)

    def dataset_id(self, tier: str = EXPERT) -> str:
        """Return the Minari id of data of a tier, as in ``imujoco/hopper-randomised-random-v0``."""
        return full_id(f"{self.robot}-{self.name}", tier)

    def draw(self, seed: int) -> Variant:
        """Return the variant that a seed draws, with percents of two decimals."""
        # Not the generator of the episode: its first numbers decide the initial state.
        generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))
        shares = generator.random(len(self.ranges)).tolist()
        changes = (
            _change(name, self._percent(bounds[0], bounds[1], share))
            for (name, bounds), share in zip(self.ranges.items(), shares, strict=True)
        )
        return Variant(self.robot, tuple(changes))

    def _percent(self, low: float, high: float, share: float) -> float:
        if self.distribution == LOG_UNIFORM:
            percent = 100 * ((1 + low / 100) ** (1 - share) * (1 + high / 100) ** share - 1)
        else:
            percent = low + share * (high - low)
        return float(min(max(round(percent, 2), low), high))


def drawing_ranges(robot: str, *, unlisted: bool = False) -> dict[str, tuple[float, float]]:
    """Return the range of each parameter of a robot: from the lowest to the highest percent of the catalogue.

    Every range includes 0, the unchanged robot.

    Args:
        robot: the robot.
        unlisted: add the parameters of categories that the catalogue lists no variants of, with ranges in
            which the robots can still be controlled.

    Example:
        >>> drawing_ranges("hopper")["mass/torsogeom"]
        (-50, 200)
    """
    ranges: dict[str, tuple[float, float]] = {}
    for category, listing in specification(robot).categories.items():
        if listing.percents or unlisted:
            low, high = min((0, *listing.percents)), max((0, *listing.percents))
            pair = (low, high) if listing.percents else _UNLISTED[category]
            ranges |= dict.fromkeys((f"{category}/{body}" for body in listing.bodies), pair)
    return ranges


def _checked_range(robot: str, name: str, bounds: Any) -> tuple[float, ...]:
    """Return the lowest and the highest percent of a parameter."""
    listed = bounds.tolist() if isinstance(bounds, np.ndarray) else bounds
    pair = tuple(map(plain_number, listed)) if isinstance(listed, Sequence) else ()
    numbers = [isinstance(bound, int | float) for bound in pair]
    if numbers != [True, True] or not pair[0] <= pair[1]:
        raise DrawingError(
            f"the range of {name} is {clipped(repr(listed))}; valid: the lowest and the highest percent"
        )
    for bound in pair:
        try:
            _change(name, bound).check(robot)
        except VariantError as error:
            raise VariantError(f"the range of {name}: {error}") from None
    return pair


def _change(name: str, percent: float) -> Change:
    category, _, body = name.partition("/")
    return Change(category, percent, body)
