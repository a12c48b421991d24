"""Variant ids: their one parser, their one formatter, and the catalogue's list.

A *change* is a *category* of physical parameter, a signed *percent* of the base value, and a *body*. A
*variant* is a robot with one change or several.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

from imujoco_minari.errors import VariantError, clipped, suggestion, unknown
from imujoco_minari.variants.changes import CHANGE_ID, GRAMMAR, Change, listing_of
from imujoco_minari.variants.pages import CATEGORIES
from imujoco_minari.variants.robots import ROBOTS, carrying, follows_page, known_robots, specification

NAMESPACE = "imujoco"
BASE = "base"
COMPOUND = "compound"
EXPERT = "expert"
_TIER = re.compile(r"[a-z][a-z0-9_]*(?:-[a-z][a-z0-9_]*)*")


@dataclass(frozen=True, order=True)
class Variant:
    """One robot with one or several physical parameters changed, or the unchanged base robot.

    Attributes:
        robot: a robot that has a page, as in ``hopper``.
        changes: the changes, in the order of ``CATEGORIES`` and then as the page lists the bodies; empty
            for the base robot. They may be given in any order.

    Raises:
        VariantError: when the robot has no such category or body, or a parameter is changed twice.

    Example:
        >>> str(Variant("hopper", (Change("friction", -50, "feet"), Change("mass", 50, "torsogeom"))))
        'hopper-massinc_50_torsogeom-frictiondec_50_feet'
    """

    # The namespace of the ids of environments and datasets. Other catalogues have others.
    namespace: ClassVar[str] = NAMESPACE

    robot: str
    changes: tuple[Change, ...] = ()

    def __post_init__(self) -> None:
        specification(self.robot)
        parameters: set[tuple[str, str]] = set()
        for change in self.changes:
            change.check(self.robot)
            for name in change.mjcf_names(self.robot):
                if (change.category, name) in parameters:
                    raise VariantError(f"{self.robot}: the {change.category} of {name} is changed twice")
                parameters.add((change.category, name))
        object.__setattr__(self, "changes", tuple(sorted(self.changes, key=self._place)))

    def _place(self, change: Change) -> tuple[int, int]:
        listing = specification(self.robot).categories[change.category]
        return CATEGORIES.index(change.category), [*listing.bodies, *listing.groups].index(change.body)

    @classmethod
    def parse(cls, text: str | Variant) -> Variant:
        """Return the variant that ``text`` names. A variant is returned as it is.

        ``text`` is a variant id (``hopper-massdec_25_leggeom``, ``hopper-base``) or the
        environment id made of it (``imujoco/hopper-massdec_25_leggeom-v0``).

        Raises:
            VariantError: when ``text`` names no variant, with the nearest one of the catalogue.
        """
        if isinstance(text, cls):
            return text
        if not isinstance(text, str):
            raise VariantError(f"a variant id is text, not {type(text).__name__}")
        name = text.removeprefix(f"{NAMESPACE}/").removesuffix("-v0")
        robot, _, rest = name.partition("-")
        if rest == BASE:
            return cls(robot)
        parts = rest.split("-")
        if not all(map(CHANGE_ID.fullmatch, parts)):
            variant_id, tier = split_name(name_in(text))
            if tier:
                raise VariantError(
                    f"{clipped(text)!r} is a dataset id, not a variant id; its variant is "
                    f"{clipped(str(cls.parse(variant_id)))!r}"
                )
            if robot in known_robots() and rest in ("all", "randomised", *specification(robot).categories):
                raise VariantError(
                    f"{clipped(text)!r} names several variants, and one is needed; "
                    f"`imujoco list --robot {robot}` lists them"
                )
            known = (str(each) for robot in known_robots() for each in (*_listed(robot), Variant(robot)))
            near = suggestion(name[:80], known)
            raise VariantError(f"malformed variant id {clipped(text)!r}{near}; {GRAMMAR}")
        try:
            return cls(robot, tuple(map(Change.parse, parts)))
        except VariantError as error:
            raise VariantError(f"{clipped(text)!r}: {error}") from None

    def __reduce__(self) -> tuple[Callable[..., Variant], tuple[Any, ...]]:
        # Another process may not know a robot of the user.
        return carrying(self.robot, type(self), self.robot, self.changes)

    def __repr__(self) -> str:
        return f"{type(self).__name__}.parse({str(self)!r})"

    def __str__(self) -> str:
        return "-".join((self.robot, *map(str, self.changes))) if self.changes else f"{self.robot}-{BASE}"

    @property
    def category(self) -> str:
        """The category of the one change; ``compound`` for several, ``base`` for none."""
        return self.changes[0].category if len(self.changes) == 1 else COMPOUND if self.changes else BASE

    @property
    def percent(self) -> float:
        """The percent of the one change; 0 for several or none."""
        return self.changes[0].percent if len(self.changes) == 1 else 0

    @property
    def body(self) -> str:
        """The body of the one change; empty for several or none."""
        return self.changes[0].body if len(self.changes) == 1 else ""

    @property
    def base(self) -> Variant:
        """The unchanged robot of this variant."""
        return Variant(self.robot)

    @property
    def mjcf_names(self) -> tuple[str, ...]:
        """Names of the parts of the model that are changed, each once."""
        names = (name for change in self.changes for name in change.mjcf_names(self.robot))
        return tuple(dict.fromkeys(names))

    @property
    def environment_id(self) -> str:
        """The Gymnasium id, ``imujoco/<variant>-v0``."""
        return f"{self.namespace}/{self}-v0"

    def dataset_id(self, tier: str = EXPERT) -> str:
        """The Minari id of this variant's data of ``tier``; the expert's is the plain id.

        Raises:
            VariantError: when ``tier`` is no tier name.
        """
        valid = isinstance(tier, str) and len(tier) <= 40 and _TIER.fullmatch(tier)
        if not valid or any(map(CHANGE_ID.fullmatch, tier.split("-"))):
            raise VariantError(
                f"malformed tier {clipped(tier)!r}; valid: lower-case words, as in expert, medium, random"
            )
        return full_id(str(self), tier, self.namespace)


def full_id(name: str, tier: str, namespace: str = NAMESPACE) -> str:
    """Return the Minari id of data of a tier; that of the expert's has no word for it."""
    return f"{namespace}/{name}{'' if tier == EXPERT else f'-{tier}'}-v0"


def name_in(dataset_id: str) -> str:
    """Return the name in a dataset id of our namespace, without version; empty for any other id."""
    if dataset_id.startswith(f"{NAMESPACE}/") and dataset_id.endswith("-v0"):
        return dataset_id.removeprefix(f"{NAMESPACE}/").removesuffix("-v0")
    return ""


def catalogue(robot: str | None = None, category: str | None = None) -> tuple[Variant, ...]:
    """Return listed variants, in the catalogue's order, of one robot and category or of all.

    Without a robot, these are the 154 published variants or those of one category. A robot that is not of
    the original must be named.

    Raises:
        VariantError: when there is no such robot or category.
    """
    if category is not None and category not in CATEGORIES:
        raise VariantError(unknown("unknown category", category, CATEGORIES))
    if robot is not None:
        specification(robot)
        if category is not None:
            listing_of(robot, category)
    return tuple(
        variant
        for each in (ROBOTS if robot is None else (robot,))
        for variant in _listed(each)
        if category in (None, variant.category)
    )


def bases() -> tuple[Variant, ...]:
    """Return the unchanged robots of the catalogue. Its 154 variants do not include them."""
    return tuple(map(Variant, ROBOTS))


def parse_dataset_id(dataset_id: str) -> tuple[Variant, str]:
    """Return the variant and the tier that a dataset id of this package names.

    Raises:
        VariantError: when it is not of the form ``imujoco/<variant>[-<tier>]-v0``.
    """
    near = ""
    if name_in(dataset_id):
        name, tier = split_name(name_in(dataset_id))
        variant, tier = Variant.parse(name), tier or EXPERT
        if dataset_id == variant.dataset_id(tier):
            return variant, tier
        near = f" (did you mean {variant.dataset_id(tier)!r}?)"
    raise VariantError(
        f"{clipped(dataset_id)!r} is not the dataset id of a variant{near}; "
        f"valid: {NAMESPACE}/<variant>[-<tier>]-v0, as in {NAMESPACE}/hopper-massdec_25_leggeom-v0"
    )


def split_name(name: str) -> tuple[str, str]:
    """Return the variant id and the tier in the name of a dataset id; the tier is empty if there is none."""
    words = name.split("-")
    end = 2
    while end < len(words) and CHANGE_ID.fullmatch(words[end]):
        end += 1
    return "-".join(words[:end]), "-".join(words[end:])


@follows_page
@cache
def _listed(robot: str) -> tuple[Variant, ...]:
    """Return the variants that a robot's page lists."""
    return tuple(
        Variant(robot, (Change(category, percent, body),))
        for category, listing in specification(robot).categories.items()
        for body in listing.bodies
        for percent in listing.percents
    )
