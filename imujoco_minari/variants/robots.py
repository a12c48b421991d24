"""The robots' pages: one TOML file for each robot (``env_specs/``) holds every fact about it.

This is the only place with facts for each robot. It knows nothing of MuJoCo.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib import resources
from types import MappingProxyType
from typing import Any, TypeVar

from imujoco_minari.errors import CatalogueError, VariantError, clipped, suggestion

CATEGORIES = ("mass", "joint", "length", "friction")

Value = TypeVar("Value", str, int)


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
class Reward:
    """The constants of a robot's reward: forward velocity - control_cost * |action|^2 + healthy.

    Attributes:
        control_cost: weight of the squared action.
        healthy: reward (per step) for a healthy state.
    """

    control_cost: float
    healthy: float


@dataclass(frozen=True)
class RobotSpecification:
    """One robot's page. Each attribute is a key of the page; ``changes`` holds one table for each category.

    Attributes:
        environment: id of the Gymnasium environment that is perturbed.
        model: file name of its MJCF among Gymnasium's assets.
        observation_size: length of an observation: all positions but the first, then all velocities.
        action_size: length of an action.
        steps_per_second: environment steps in one simulated second.
        root_joints: MJCF names of the joints that move the torso: forward, up, and about the y axis.
        feet: MJCF names of the geoms that stand on the floor.
        healthy_z_range: torso heights (m) outside which an episode ends; None where no height ends it.
        reward: the constants of its reward.
        stance: MJCF name of a joint -> its angle (degrees) in portraits; the other joints stay at rest.
        training: start -> hyperparameters in which the robot differs from all others.
        changes: category -> its percents and bodies.
    """

    environment: str
    model: str
    observation_size: int
    action_size: int
    steps_per_second: int
    root_joints: tuple[str, str, str]
    feet: tuple[str, ...]
    healthy_z_range: tuple[float, float] | None
    reward: Reward
    stance: Mapping[str, float]
    training: Mapping[str, Mapping[str, Any]]
    changes: Mapping[str, Change]

    @property
    def title(self) -> str:
        """The robot's name as Gymnasium writes it, for example ``HalfCheetah``."""
        return self.environment.rpartition("-v")[0]

    @property
    def sizes(self) -> tuple[int, int]:
        """Length of an observation, length of an action."""
        return self.observation_size, self.action_size

    @property
    def forward_velocity(self) -> int:
        """Index of the torso's forward velocity in an observation; as many positions come before it."""
        return self.observation_size // 2


def specification(robot: str) -> RobotSpecification:
    """Return the page of ``robot``.

    Raises:
        VariantError: when there is no such robot.
    """
    if robot not in ROBOTS:
        shown = clipped(robot)
        raise VariantError(f"unknown robot {shown!r}{suggestion(shown, ROBOTS)}; valid: {', '.join(ROBOTS)}")
    return _PAGES[robot]


def parse_specification(text: str, name: str) -> RobotSpecification:
    """Return the robot specification written in the TOML ``text`` of the file ``name``.

    Raises:
        CatalogueError: when the text is not TOML, or a key is missing, unknown or of the wrong kind.
    """
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise CatalogueError(f"{name}: not TOML: {error}") from None
    known = {field.name for field in fields(RobotSpecification)} - {"changes"} | {*CATEGORIES}
    unknown = sorted(set(data) - known)
    if unknown:
        raise CatalogueError(
            f"{name}: unknown key {unknown[0]!r}{suggestion(unknown[0], known)}; "
            f"valid: {', '.join(sorted(known))}"
        )
    root_joints, feet = _strings(data, "root_joints", name), tuple(_strings(data, "feet", name))
    if len(root_joints) != 3:
        raise CatalogueError(f"{name}: root_joints must name three joints: forward, up, and about the y axis")
    z_range = data.get("healthy_z_range")
    if z_range is not None and not (
        isinstance(z_range, list) and len(z_range) == 2 and all(isinstance(z, float) for z in z_range)
    ):
        raise CatalogueError(f"{name}: healthy_z_range must be two floats, in metres")
    reward = _numbers(data, "reward", name)
    if set(reward) != {"control_cost", "healthy"}:
        raise CatalogueError(f"{name}: [reward] must hold control_cost and healthy, and nothing else")
    return RobotSpecification(
        environment=_value(data, "environment", str, name),
        model=_value(data, "model", str, name),
        observation_size=_value(data, "observation_size", int, name),
        action_size=_value(data, "action_size", int, name),
        steps_per_second=_value(data, "steps_per_second", int, name),
        root_joints=(root_joints[0], root_joints[1], root_joints[2]),
        feet=feet,
        healthy_z_range=None if z_range is None else (z_range[0], z_range[1]),
        reward=Reward(**reward),
        stance=_numbers(data, "stance", name),
        training=_training(data, name),
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


def _training(data: dict[str, Any], name: str) -> Mapping[str, Mapping[str, Any]]:
    table = data.get("training", {})
    if not isinstance(table, dict) or not all(isinstance(values, dict) for values in table.values()):
        raise CatalogueError(f"{name}: [training] must hold one table for each start, as [training.warm]")
    return MappingProxyType({start: MappingProxyType(values) for start, values in table.items()})


def _value(data: dict[str, Any], key: str, kind: type[Value], name: str) -> Value:
    value = data.get(key)
    if type(value) is not kind or (isinstance(value, int) and value < 1):
        raise CatalogueError(f"{name}: {key} must be {'text' if kind is str else 'a whole number above 0'}")
    return value


def _strings(data: dict[str, Any], key: str, name: str) -> list[str]:
    value = data.get(key)
    if not isinstance(value, list) or not value or not all(isinstance(item, str) for item in value):
        raise CatalogueError(f"{name}: {key} must be a list of names")
    return value


def _numbers(data: dict[str, Any], key: str, name: str) -> Mapping[str, float]:
    table = data.get(key, {})
    if not isinstance(table, dict) or not all(type(value) in (int, float) for value in table.values()):
        raise CatalogueError(f"{name}: [{key}] must hold numbers")
    return MappingProxyType({item: float(value) for item, value in table.items()})


def _read_pages() -> Mapping[str, RobotSpecification]:
    """Return the robots that have a page, the smallest first."""
    pages = {
        page.name.removesuffix(".toml"): parse_specification(page.read_text("utf-8"), page.name)
        for page in resources.files("imujoco_minari.env_specs").iterdir()
        if page.name.endswith(".toml")
    }
    order = sorted(pages, key=lambda robot: (pages[robot].observation_size, robot))
    return MappingProxyType({robot: pages[robot] for robot in order})


_PAGES = _read_pages()
ROBOTS = tuple(_PAGES)
