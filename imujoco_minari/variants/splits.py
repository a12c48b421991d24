"""Splits for generalisation: held-out variants, fixed and named.

The splits are data (``splits.toml``), so that a paper can name one and mean the same variants.
They are over the catalogue of 154; the bases are on neither side.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from types import MappingProxyType
from typing import Any

from imujoco_minari.errors import CatalogueError, VariantError, suggestion
from imujoco_minari.variants import Variant, catalogue, specification

_RULES = ("category", "body", "percent")


@dataclass(frozen=True)
class HeldOut:
    """A named split of one robot's published variants.

    Attributes:
        name: as in ``hopper-friction-v1``; the same name is the same split for ever.
        robot: whose variants are split.
        description: what is held out.
        train: ids of the variants to learn from.
        test: ids of the variants that are held out.
    """

    name: str
    robot: str
    description: str
    train: tuple[str, ...]
    test: tuple[str, ...]


def held_out(name: str) -> HeldOut:
    """Return the held-out split of this name.

    Raises:
        VariantError: when there is none.
    """
    splits = _splits()
    if name not in splits:
        raise VariantError(
            f"unknown split {name[:80]!r}{suggestion(name[:80], splits)}; valid: {', '.join(splits)}"
        )
    return splits[name]


def held_out_names(robot: str | None = None) -> tuple[str, ...]:
    """Return the names of the held-out splits, of one robot or of all.

    Raises:
        VariantError: when there is no such robot.
    """
    if robot is not None:
        specification(robot)
    return tuple(name for name, split in _splits().items() if robot in (None, split.robot))


def parse_splits(text: str, name: str) -> Mapping[str, HeldOut]:
    """Return the splits written in the TOML ``text`` of the file ``name``.

    Raises:
        CatalogueError: when it is no TOML, or a key or value in it is none of a split's.
    """
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise CatalogueError(f"{name}: not TOML: {error}") from None
    return MappingProxyType(
        {title: _split(title, table, f"{name}: [{title}]") for title, table in data.items()}
    )


def _split(title: str, table: Any, where: str) -> HeldOut:
    if not isinstance(table, dict) or set(table) != {"robot", "description", "held_out"}:
        raise CatalogueError(f"{where} must hold robot, description and held_out, and nothing else")
    rules = table["held_out"]
    if not isinstance(rules, list) or not all(isinstance(rule, dict) and rule for rule in rules):
        raise CatalogueError(f"{where} held_out must be a list of rules, as {{ category = ['friction'] }}")
    for rule in rules:
        unknown = sorted(set(rule) - set(_RULES))
        if unknown:
            raise CatalogueError(f"{where} unknown rule {unknown[0]!r}; valid: {', '.join(_RULES)}")
    variants = catalogue(table["robot"])
    test = tuple(variant for variant in variants if any(_follows(variant, rule) for rule in rules))
    for rule in rules:
        if not any(_follows(variant, rule) for variant in variants):
            raise CatalogueError(f"{where} no variant follows {rule}")
    return HeldOut(
        title,
        table["robot"],
        table["description"],
        tuple(str(variant) for variant in variants if variant not in test),
        tuple(str(variant) for variant in test),
    )


def _follows(variant: Variant, rule: Mapping[str, Any]) -> bool:
    return all(getattr(variant, name) in wanted for name, wanted in rule.items())


@cache
def _splits() -> Mapping[str, HeldOut]:
    file = resources.files("imujoco_minari.variants").joinpath("splits.toml")
    return parse_splits(file.read_text("utf-8"), "splits.toml")
