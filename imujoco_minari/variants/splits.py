"""Splits for generalisation: variants to train on, and held-out variants to test on.

The named splits are data, so that a paper can name one and mean the same variants for ever. The splits of one
robot are in its page, those over several in ``splits.toml``. The bases are on neither side.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from imujoco_minari.errors import CatalogueError, VariantError, clipped, unknown
from imujoco_minari.short_repr import short_repr
from imujoco_minari.variants.ids import Variant, catalogue
from imujoco_minari.variants.robots import ROBOTS, follows_page, known_robots, specification

_RULES = ("robot", "category", "body", "percent", "variant")


@dataclass(frozen=True)
class HeldOut:
    """A split of variants into those to train on and those that are held out.

    :func:`held_out` returns the named splits of this package. Make your own from two lists of ids.

    Attributes:
        name: of the split, as ``hopper-friction-v1``.
        train: ids of the variants to train on.
        test: ids of the variants that are held out.
        description: of what is held out.

    Raises:
        VariantError: when an id is not of a variant, a side is empty, or a variant appears twice.

    Example:
        >>> HeldOut("mine", train=["hopper-base"], test=["hopper-massdec_25_leggeom"]).robots
        ('hopper',)
    """

    name: str
    train: tuple[str, ...]
    test: tuple[str, ...]
    description: str = ""

    __repr__ = short_repr

    def __post_init__(self) -> None:
        object.__setattr__(self, "train", self._ids(self.train))
        object.__setattr__(self, "test", self._ids(self.test))
        ids = self.train + self.test
        if len(set(ids)) < len(ids):
            twice = next(variant for variant in ids if ids.count(variant) > 1)
            raise VariantError(f"split {self.name}: {twice} appears twice in train and test")

    def _ids(self, side: Any) -> tuple[str, ...]:
        if isinstance(side, str) or not isinstance(side, Iterable):
            raise VariantError(
                f"split {self.name}: expected a list of variant ids, not {clipped(repr(side))}"
            )
        ids = tuple(str(Variant.parse(str(variant))) for variant in side)
        if not ids:
            raise VariantError(f"split {self.name}: train and test each need at least one variant")
        return ids

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots of the variants, those of ``train`` first."""
        return tuple(dict.fromkeys(Variant.parse(variant).robot for variant in self.train + self.test))


def held_out(name: str) -> HeldOut:
    """Return the named split ``name``.

    Raises:
        VariantError: when no split has this name.

    Example:
        >>> held_out("hopper-friction-v1").test[0]
        'hopper-frictiondec_50_feet'
    """
    splits = _splits(known_robots())
    if not isinstance(name, str) or name not in splits:
        raise VariantError(unknown("unknown split", name, splits))
    return splits[name]


def held_out_names(robot: str | None = None) -> tuple[str, ...]:
    """Return the names of the splits over the catalogue's 154 variants, or of the splits within one robot.

    Raises:
        VariantError: when ``robot`` is not a robot.
    """
    return tuple(_splits(ROBOTS)) if robot is None else tuple(_page_splits(robot))


def _split(title: str, table: Any, where: str) -> HeldOut:
    keys = {"description", "held_out"}
    if not isinstance(table, dict) or set(table) - {"robot"} != keys:
        raise CatalogueError(f"{where} must hold description, held_out and, if within one robot, robot")
    rules = table["held_out"]
    if not isinstance(rules, list) or not all(map(_is_rule, rules)):
        raise CatalogueError(f"{where} held_out must be a list of rules, as {{ category = ['friction'] }}")
    variants = catalogue(table.get("robot"))
    held: set[Variant] = set()
    for rule in rules:
        unknown = sorted(set(rule) - set(_RULES))
        if unknown:
            raise CatalogueError(f"{where} unknown rule {unknown[0]!r}; valid: {', '.join(_RULES)}")
        followers = {variant for variant in variants if _follows(variant, rule)}
        if not followers:
            raise CatalogueError(f"{where} no variant follows {rule}")
        held |= followers
    return HeldOut(
        title,
        train=tuple(str(variant) for variant in variants if variant not in held),
        test=tuple(str(variant) for variant in variants if variant in held),
        description=table["description"],
    )


def _is_rule(rule: Any) -> bool:
    return isinstance(rule, dict) and bool(rule) and all(isinstance(each, list) for each in rule.values())


def _follows(variant: Variant, rule: Mapping[str, Any]) -> bool:
    return all(
        (str(variant) if name == "variant" else getattr(variant, name)) in wanted
        for name, wanted in rule.items()
    )


def _splits(within: Iterable[str]) -> dict[str, HeldOut]:
    """Return the named splits: those within each of these robots, then those over several."""
    parts = (*map(_page_splits, within), _shared())
    return {title: split for part in parts for title, split in part.items()}


@follows_page
@cache
def _page_splits(robot: str) -> Mapping[str, HeldOut]:
    splits = {}
    for name, table in specification(robot).splits.items():
        title = f"{robot}-{name}"
        splits[title] = _split(title, {**table, "robot": robot}, f"{robot}.toml: [splits.{name}]")
    return splits


@cache
def _shared() -> Mapping[str, HeldOut]:
    file = Path(__file__).with_name("splits.toml")
    tables = tomllib.loads(file.read_text("utf-8"))
    return {title: _split(title, table, f"splits.toml: [{title}]") for title, table in tables.items()}
