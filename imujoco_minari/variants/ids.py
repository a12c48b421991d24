"""Variant ids: their one parser, their one formatter, and the catalogue's list.

A *variant* is a robot with one *category* of physical parameter changed by a signed *percent* on one *body*.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar

from imujoco_minari.errors import VariantError, clipped, suggestion
from imujoco_minari.variants.pages import CATEGORIES, Listing
from imujoco_minari.variants.robots import ROBOTS, adopt_page, carried_page, known_robots, specification

NAMESPACE = "imujoco"
BASE = "base"
EXPERT = "expert"
# Beyond this a model still compiles but means nothing; it also bounds hostile ids.
MAX_PERCENT = 10_000

_ID = re.compile(
    r"(?P<robot>[a-z0-9]+)-(?P<category>[a-z]+?)(?P<sign>inc|dec)_(?P<percent>[0-9]+(?:p[0-9]+)?)_(?P<body>[a-z0-9]+)"
)
# One change of an id, as in massdec_25_leggeom or massinc_37p5_leggeom.
_CHANGE = re.compile(r"[a-z]+?(?:inc|dec)_[0-9]+(?:p[0-9]+)?_[a-z0-9]+", re.ASCII)
_DATASET_ID = re.compile(r"(?:(?P<namespace>[-_\w/]+)/)?(?P<name>[-_\w]+)-v(?P<version>[0-9]{1,6})")
_TIER = re.compile(r"[a-z][a-z0-9_]*(?:-[a-z][a-z0-9_]*)*")


@dataclass(frozen=True, order=True)
class Variant:
    """One robot with one physical parameter changed, or the unchanged base robot.

    Attributes:
        robot: a robot that has a page, as in ``hopper``.
        category: ``mass``, ``joint``, ``length`` or ``friction``; ``base`` for the base robot.
        percent: signed change in percent of the base value, with at most two decimals; 0 for the base robot.
        body: the MJCF name without underscores, ``feet`` for friction; empty for the base robot.

    Raises:
        VariantError: when the four do not name a variant.
    """

    # The namespace of the ids of environments and datasets. Other catalogues have others.
    namespace: ClassVar[str] = NAMESPACE

    robot: str
    category: str
    percent: float
    body: str

    def __post_init__(self) -> None:
        specification(self.robot)
        if self.category == BASE:
            if self.percent or self.body:
                raise VariantError(f"{self.robot}-{BASE}: the base robot has no percent and no body")
            return
        change = _listing(self.robot, self.category)
        if self.body not in change.bodies:
            raise VariantError(
                f"{self.robot} has no body {self.body!r} for {self.category}"
                f"{suggestion(self.body, change.bodies)}; valid: {', '.join(change.bodies)}"
            )
        check_percent(self.percent)
        if isinstance(self.percent, float) and self.percent.is_integer():
            object.__setattr__(self, "percent", int(self.percent))
        if self.percent <= -100:
            raise VariantError(
                f"percent {self.percent} leaves nothing of the {self.category}; valid: above -100"
            )
        if self.percent > MAX_PERCENT:
            raise VariantError(f"percent {self.percent} is too large; valid: at most {MAX_PERCENT}")
        if self.category == "joint" and self.percent > 0:
            raise VariantError(
                f"a joint's range can only shrink, not grow by {self.percent} %; valid: -99 to 0"
            )

    @classmethod
    def parse(cls, text: str) -> Variant:
        """Return the variant that ``text`` names.

        ``text`` is a variant id (``hopper-massdec_25_leggeom``, ``hopper-base``) or the
        environment id made of it (``imujoco/hopper-massdec_25_leggeom-v0``).

        Raises:
            VariantError: when ``text`` names no variant, with the nearest one of the catalogue.
        """
        if not isinstance(text, str):
            raise VariantError(f"a variant id is text, not {type(text).__name__}")
        name = text.removeprefix(f"{NAMESPACE}/").removesuffix("-v0")
        robot, _, rest = name.partition("-")
        if rest == BASE:
            return cls(robot, BASE, 0, "")
        words = rest.split("-")
        if len(words) > 1 and all(map(_CHANGE.fullmatch, words)):
            from imujoco_minari.variants.compound import compound

            return compound(cls.parse(f"{robot}-{word}") for word in words)
        match = _ID.fullmatch(name)
        if match is None:
            raise VariantError(
                f"malformed variant id {clipped(text)!r}{suggestion(name[:80], _known_ids())}; "
                "valid: <robot>-<category><inc|dec>_<percent>_<body>, "
                "as in hopper-massdec_25_leggeom, or <robot>-base"
            )
        digits, _, decimals = match["percent"].partition("p")
        if len(digits) > 1 and digits[0] == "0":
            raise VariantError(f"{clipped(text)!r}: write the percent without leading zeros")
        if decimals[-1:] == "0" or len(decimals) > 2:
            raise VariantError(
                f"{clipped(text)!r}: write the percent with at most two decimals, without zeros at the end"
            )
        if len(digits) > len(str(MAX_PERCENT)):
            raise VariantError(f"{clipped(text)!r}: the percent is too large; valid: at most {MAX_PERCENT}")
        if digits == "0" and not decimals and match["sign"] == "dec":
            raise VariantError(f"{clipped(text)!r}: write a change of 0 % as inc_0")
        percent = float(f"{digits}.{decimals}") if decimals else int(digits)
        try:
            sign = 1 if match["sign"] == "inc" else -1
            return cls(match["robot"], match["category"], sign * percent, match["body"])
        except VariantError as error:
            raise VariantError(f"{clipped(text)!r}: {error}") from None

    def __reduce__(self) -> tuple[Callable[..., Variant], tuple[object, ...]]:
        # Another process may not know a robot of the user: its page travels with the variant.
        page = carried_page(self.robot)
        values = (self.robot, self.category, self.percent, self.body)
        return _with_page, (type(self), None if page is None else dict(page), *values)

    def __str__(self) -> str:
        if self.category == BASE:
            return f"{self.robot}-{BASE}"
        sign = "inc" if self.percent >= 0 else "dec"
        return f"{self.robot}-{self.category}{sign}_{str(abs(self.percent)).replace('.', 'p')}_{self.body}"

    @property
    def changes(self) -> tuple[Variant, ...]:
        """The changes of single parameters, in the order of contexts; none for the base robot."""
        return () if self.category == BASE else (self,)

    @property
    def factor(self) -> float:
        """The factor on the base value, ``1 + percent / 100``."""
        return (100 + self.percent) / 100

    @property
    def base(self) -> Variant:
        """The unchanged robot of this variant."""
        return Variant(self.robot, BASE, 0, "")

    def milder(self, count: int) -> tuple[Variant, ...]:
        """Return variants between the base and this one, in even steps of percent, the mildest first.

        Args:
            count: how many; fewer where whole percents do not suffice, none for the base robot.
        """
        percents = (round(self.percent * step / (count + 1)) for step in range(1, count + 1))
        between = dict.fromkeys(percent for percent in percents if percent not in (0, self.percent))
        return tuple(replace(self, percent=percent) for percent in between)

    @property
    def mjcf_names(self) -> tuple[str, ...]:
        """Names of the MJCF geoms (joints, for the category ``joint``) that are changed."""
        if self.category == BASE:
            return ()
        return specification(self.robot).categories[self.category].bodies[self.body]

    @property
    def environment_id(self) -> str:
        """The Gymnasium id, ``imujoco/<variant>-v0``."""
        return f"{self.namespace}/{self}-v0"

    def dataset_id(self, tier: str = EXPERT) -> str:
        """The Minari id of this variant's data of ``tier``; the expert's is the plain id.

        Raises:
            VariantError: when ``tier`` is no tier name.
        """
        if not _TIER.fullmatch(tier) or len(tier) > 40:
            raise VariantError(
                f"malformed tier {clipped(tier)!r}; valid: lower-case words, as in expert, medium, random"
            )
        suffix = "" if tier == EXPERT else f"-{tier}"
        return f"{self.namespace}/{self}{suffix}-v0"


def catalogue(robot: str | None = None, category: str | None = None) -> tuple[Variant, ...]:
    """Return listed variants, in the catalogue's order, of one robot and category or of all.

    Without a robot, these are the 154 published variants or those of one category. A robot that is not of
    the original must be named.

    Raises:
        VariantError: when there is no such robot or category.
    """
    if category is not None and category not in CATEGORIES:
        raise VariantError(
            f"unknown category {clipped(category)!r}{suggestion(category[:80], CATEGORIES)}; "
            f"valid: {', '.join(CATEGORIES)}"
        )
    if robot is not None and category is not None:
        _listing(robot, category)
    return tuple(
        variant
        for each in (ROBOTS if robot is None else (robot,))
        for variant in _listed(each)
        if category in (None, variant.category)
    )


def bases() -> tuple[Variant, ...]:
    """Return the unchanged robots of the catalogue. Its 154 variants do not include them."""
    return tuple(Variant(robot, BASE, 0, "") for robot in ROBOTS)


def parse_dataset_id(dataset_id: str) -> tuple[Variant, str]:
    """Return the variant and the tier that a dataset id of this package names.

    Raises:
        VariantError: when it is not of the form ``imujoco/<variant>[-<tier>]-v0``.
    """
    match = _DATASET_ID.fullmatch(dataset_id)
    if match is None or match["namespace"] != NAMESPACE:
        raise VariantError(
            f"{clipped(dataset_id)!r} is not the dataset id of a variant; "
            f"valid: {NAMESPACE}/<variant>[-<tier>]-v0, as in {NAMESPACE}/hopper-massdec_25_leggeom-v0"
        )
    variant, tier = split_name(match["name"])
    return Variant.parse(variant), tier or EXPERT


def split_name(name: str) -> tuple[str, str]:
    """Return the variant id and the tier in the name of a dataset id; the tier is empty if there is none."""
    words = name.split("-")
    end = 2
    while end < len(words) and _CHANGE.fullmatch(words[end]):
        end += 1
    return "-".join(words[:end]), "-".join(words[end:])


def check_percent(percent: float) -> None:
    """Check that a percent is a number with at most two decimals.

    Raises:
        VariantError: if it is not.
    """
    if (
        isinstance(percent, bool)
        or not isinstance(percent, int | float)
        or not abs(percent) < float("inf")
        or round(percent, 2) != percent
    ):
        raise VariantError(f"percent must be a number with at most two decimals, not {percent!r}")


def _listing(robot: str, category: str) -> Listing:
    """Return a category of a robot's page; raise a VariantError when the robot has no such category."""
    categories = specification(robot).categories
    if category not in categories:
        raise VariantError(
            f"{robot} has no category {clipped(category)!r}{suggestion(category[:80], categories)}; "
            f"valid: {', '.join(categories)}"
        )
    return categories[category]


@cache
def _listed(robot: str) -> tuple[Variant, ...]:
    """Return the variants that a robot's page lists."""
    return tuple(
        Variant(robot, category, percent, body)
        for category, listing in specification(robot).categories.items()
        for body in listing.bodies
        for percent in listing.percents
    )


def _known_ids() -> list[str]:
    """Return the listed ids of all known robots and their bases, for suggestions."""
    return [
        str(variant) for robot in known_robots() for variant in (*_listed(robot), Variant(robot, BASE, 0, ""))
    ]


def _with_page(kind: type[Variant], page: Mapping[str, str] | None, robot: str, *values: Any) -> Variant:
    """Return a variant that comes from another process, and make its robot known first."""
    if page is not None:
        adopt_page(robot, page)
    return kind(robot, *values)
