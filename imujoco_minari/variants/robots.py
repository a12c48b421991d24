"""The robots' pages: one TOML file a robot (``env_specs/``), with every fact about it that the package needs.

This is the only place with a table per robot. It knows nothing of MuJoCo.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from types import MappingProxyType
from typing import Any

from imujoco_minari.errors import CatalogueError, VariantError, clipped, suggestion

ROBOTS = ("hopper", "halfcheetah", "walker2d")
CATEGORIES = ("mass", "joint", "length", "friction")


@dataclass(frozen=True)
class Change:
    """What the catalogue lists for one category of one robot.

    Attributes:
        percents: the published signed changes.
        bodies: id name -> MJCF names of the geoms or joints behind it.
    """

    percents: tuple[int, ...]
    bodies: Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class RobotSpecification:
    """One robot's page of the catalogue.

    Attributes:
        environment: id of the Gymnasium environment that is perturbed.
        model: file name of its MJCF among Gymnasium's assets.
        feet: MJCF names of the geoms that stand on the floor.
        healthy_z_range: torso heights (m) outside which an episode ends; None where no height ends it.
        changes: category -> its percents and bodies.
    """

    environment: str
    model: str
    feet: tuple[str, ...]
    healthy_z_range: tuple[float, float] | None
    changes: Mapping[str, Change]


def specification(robot: str) -> RobotSpecification:
    """Return the catalogue's page for ``robot``.

    Raises:
        VariantError: when there is no such robot.
    """
    if robot not in ROBOTS:
        shown = clipped(robot)
        raise VariantError(f"unknown robot {shown!r}{suggestion(shown, ROBOTS)}; valid: {', '.join(ROBOTS)}")
    return _specifications()[robot]


def parse_specification(text: str, name: str) -> RobotSpecification:
    """Return the robot specification written in the TOML ``text`` of the file ``name``.

    Raises:
        CatalogueError: when the text is no TOML, or a key is missing, unknown or of the wrong kind.
    """
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise CatalogueError(f"{name}: not TOML: {error}") from None
    known = {"environment", "model", "feet", "healthy_z_range", *CATEGORIES}
    unknown = sorted(set(data) - known)
    if unknown:
        raise CatalogueError(
            f"{name}: unknown key {unknown[0]!r}{suggestion(unknown[0], known)}; "
            f"valid: {', '.join(sorted(known))}"
        )
    feet = tuple(_strings(data, "feet", name))
    z_range = data.get("healthy_z_range")
    if z_range is not None and not (
        isinstance(z_range, list) and len(z_range) == 2 and all(isinstance(z, float) for z in z_range)
    ):
        raise CatalogueError(f"{name}: healthy_z_range must be two floats, in metres")
    return RobotSpecification(
        environment=_string(data, "environment", name),
        model=_string(data, "model", name),
        feet=feet,
        healthy_z_range=None if z_range is None else (z_range[0], z_range[1]),
        changes=MappingProxyType({category: _change(data, category, feet, name) for category in CATEGORIES}),
    )


def _change(data: dict[str, Any], category: str, feet: tuple[str, ...], name: str) -> Change:
    table = data.get(category)
    if not isinstance(table, dict) or set(table) != {"percents", "bodies"}:
        raise CatalogueError(f"{name}: [{category}] must hold percents and bodies, and nothing else")
    percents = table["percents"]
    if not isinstance(percents, list) or not all(type(p) is int and p > -100 and p != 0 for p in percents):
        raise CatalogueError(f"{name}: [{category}] percents must be whole numbers above -100, and not 0")
    names = _strings(table, "bodies", f"{name}: [{category}]")
    return Change(
        percents=tuple(percents),
        bodies=MappingProxyType({n.replace("_", ""): feet if n == "feet" else (n,) for n in names}),
    )


def _string(data: dict[str, Any], key: str, name: str) -> str:
    value = data.get(key)
    if not isinstance(value, str):
        raise CatalogueError(f"{name}: {key} must be text")
    return value


def _strings(data: dict[str, Any], key: str, name: str) -> list[str]:
    value = data.get(key)
    if not isinstance(value, list) or not value or not all(isinstance(item, str) for item in value):
        raise CatalogueError(f"{name}: {key} must be a list of names")
    return value


@cache
def _specifications() -> Mapping[str, RobotSpecification]:
    folder = resources.files("imujoco_minari.env_specs")
    return {
        robot: parse_specification(folder.joinpath(f"{robot}.toml").read_text("utf-8"), f"{robot}.toml")
        for robot in ROBOTS
    }
