"""The page of a robot: one TOML file holds every fact about it. This module reads a page's text.

It knows nothing of MuJoCo.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, TypeAlias

from imujoco_minari.errors import CatalogueError, unknown
from imujoco_minari.short_repr import short_repr

# The order of changes in ids, and in which they are applied: a mass before the shape that follows from it.
CATEGORIES = ("mass", "joint", "length", "friction", "gravity", "gear", "damping", "armature", "size")

# The kinds of single values: the name in messages, and whether a value is of the kind.
_Kind: TypeAlias = tuple[str, Callable[[Any], bool]]
_TEXT: _Kind = "text", lambda value: isinstance(value, str)
_FLAG: _Kind = "true or false", lambda value: isinstance(value, bool)
# TOML has integers of any length. Larger ones mean nothing here, and cannot become a float.
_LARGEST = 10**9
_COUNT: _Kind = (
    "a whole number above 0, and at most 10^9",
    lambda value: type(value) is int and 0 < value <= _LARGEST,
)
_SIZE: _Kind = (
    "a number above 0, and at most 10^9",
    lambda value: type(value) in (int, float) and 0 < value <= _LARGEST,
)

# The kinds of starts of a training run: see `imujoco_minari/training/hyperparameters.toml`.
STARTS = ("scratch", "warm", "near", "improve", "universal")

_ENVIRONMENT = re.compile(r"[A-Z][A-Za-z0-9]*-v5", re.ASCII)


@dataclass(frozen=True)
class Listing:
    """What the catalogue lists for one category of one robot.

    Attributes:
        percents: the listed signed changes; empty if the catalogue lists no variants of the category.
        bodies: id name -> MJCF names of the parts of the model behind it.
        groups: id name -> MJCF names of the parts that change together. The catalogue does not list them.
        widen: MJCF names of the joints whose range may also grow.
    """

    percents: tuple[int, ...]
    bodies: Mapping[str, tuple[str, ...]]
    groups: Mapping[str, tuple[str, ...]]
    widen: tuple[str, ...]

    __repr__ = short_repr

    def names(self, body: str) -> tuple[str, ...]:
        """Return the MJCF names behind a body or a group; empty if the robot has no such body."""
        return self.bodies.get(body) or self.groups.get(body) or ()


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
    """A robot's page. Each attribute is a key of the page; ``categories`` holds a table for each category.

    Attributes:
        environment: id of the Gymnasium environment that is perturbed, one of Gymnasium's MuJoCo
            environments of version 5.
        model: name of its MJCF file: a file beside the page, or one of Gymnasium's assets.
        listed: whether the catalogue lists the robot without being asked for it.
        observation_size: length of an observation.
        observed_positions: how many positions an observation begins with. All velocities follow, the
            forward velocity first.
        action_size: length of an action.
        action_bound: largest absolute value of an action's entry.
        steps_per_second: environment steps in one simulated second.
        max_episode_steps: steps after which an episode is truncated; None for the environment's own limit.
        root_joints: MJCF names of the joints that move the torso; empty for a robot that is fixed.
        feet: MJCF names of the geoms that stand on the floor.
        healthy_z_range: torso heights (m) outside which an episode ends; None where no height ends it.
        reward: the constants of its reward; None where the reward has another formula.
        stance: MJCF name of a joint -> its angle (degrees) in portraits; the other joints stay at rest.
        training: start -> hyperparameters in which the robot differs from all others.
        splits: name -> description and rules of a held-out split over the robot's variants.
        groups: id name -> MJCF names of parts of the model that may change together.
        categories: category -> its percents and bodies, for the categories of the robot.
    """

    environment: str
    model: str
    listed: bool
    observation_size: int
    observed_positions: int
    action_size: int
    action_bound: float
    steps_per_second: float
    max_episode_steps: int | None
    root_joints: tuple[str, ...]
    feet: tuple[str, ...]
    healthy_z_range: tuple[float, float] | None
    reward: Reward | None
    stance: Mapping[str, float]
    training: Mapping[str, Mapping[str, Any]]
    splits: Mapping[str, Mapping[str, Any]]
    groups: Mapping[str, tuple[str, ...]]
    categories: Mapping[str, Listing]

    def __repr__(self) -> str:
        return (
            f"RobotSpecification({self.environment}, {self.model}, {self.observation_size} observations, "
            f"{self.action_size} actions, categories {', '.join(self.categories)})"
        )

    @property
    def title(self) -> str:
        """The robot's name as Gymnasium writes it, for example ``HalfCheetah``."""
        return self.environment.rpartition("-v")[0]

    @property
    def sizes(self) -> tuple[int, int]:
        """Length of an observation, length of an action."""
        return self.observation_size, self.action_size


def parse_specification(text: str, name: str) -> RobotSpecification:
    """Return the robot specification written in the TOML ``text`` of the file ``name``.

    Raises:
        CatalogueError: when the text is not TOML, or a key is missing, unknown or of the wrong kind.
    """
    try:
        data = tomllib.loads(text)
    # A ValueError: it is not TOML, or a number has thousands of digits.
    except (ValueError, RecursionError) as error:
        raise CatalogueError(f"{name}: not TOML: {error}") from None
    known = {field.name for field in fields(RobotSpecification)} - {"categories"} | {*CATEGORIES}
    strangers = sorted(set(data) - known)
    if strangers:
        raise CatalogueError(unknown(f"{name}: unknown key", strangers[0], sorted(known)))
    page = _Page(data, name)
    environment, model = page.value("environment", _TEXT), page.value("model", _TEXT)
    if not _ENVIRONMENT.fullmatch(environment):
        raise CatalogueError(
            f"{name}: environment {environment!r} is not the id of a MuJoCo environment of Gymnasium of "
            "version 5; valid: as in Hopper-v5"
        )
    if not re.fullmatch(r"[\w.-]+\.xml", model):
        raise CatalogueError(
            f"{name}: model {model!r} is not the name of an MJCF file; valid: a file beside the page or one "
            "of Gymnasium's, as in hopper.xml"
        )
    feet = page.names(data["feet"], "feet") if "feet" in data else ()
    groups = page.groups()
    specification = RobotSpecification(
        environment=environment,
        model=model,
        listed=page.value("listed", _FLAG, False),
        observation_size=page.value("observation_size", _COUNT),
        observed_positions=page.value("observed_positions", _COUNT),
        action_size=page.value("action_size", _COUNT),
        action_bound=page.value("action_bound", _SIZE, 1.0),
        steps_per_second=page.value("steps_per_second", _SIZE),
        max_episode_steps=page.value("max_episode_steps", _COUNT) if "max_episode_steps" in data else None,
        root_joints=page.names(data.get("root_joints"), "root_joints", least=0),
        feet=feet,
        healthy_z_range=page.healthy_z_range(),
        reward=page.reward(),
        stance=page.numbers("stance"),
        training=page.training(),
        splits=page.tables("splits", "split, as [splits.mass-v1]"),
        groups=groups,
        categories=MappingProxyType(
            {category: page.listing(category, feet, groups) for category in CATEGORIES if category in data}
        ),
    )
    if specification.observed_positions >= specification.observation_size:
        raise CatalogueError(f"{name}: observed_positions must be less than observation_size")
    return specification


class _Page:
    """The checked values of a page's keys."""

    def __init__(self, data: dict[str, Any], name: str) -> None:
        self._data, self._name = data, name

    def value(self, key: str, kind: _Kind, default: Any = None) -> Any:
        name, is_valid = kind
        value = self._data.get(key, default)
        if not is_valid(value):
            missing = "" if key in self._data else "; the page has no such key"
            raise self._error(f"{key} must be {name}{missing}")
        return value

    def numbers(self, key: str) -> Mapping[str, float]:
        table = self._table(key, "numbers", int, float)
        if not all(abs(value) <= _LARGEST for value in table.values()):
            raise self._error(f"[{key}] must hold finite numbers")
        return MappingProxyType({item: float(value) for item, value in table.items()})

    def tables(self, key: str, item: str) -> Mapping[str, Mapping[str, Any]]:
        table = self._table(key, f"one table for each {item}", dict)
        return MappingProxyType({name: MappingProxyType(values) for name, values in table.items()})

    def training(self) -> Mapping[str, Mapping[str, Any]]:
        tables = self.tables("training", "start, as [training.warm]")
        for start, values in tables.items():
            if start not in STARTS:
                raise self._error(unknown("[training] has an unknown start", start, STARTS))
            for name, value in values.items():
                if type(value) not in (int, float) or not 0 <= value <= _LARGEST:
                    raise self._error(f"[training.{start}] {name} must be a number of at least 0")
        return tables

    def healthy_z_range(self) -> tuple[float, float] | None:
        match self._data.get("healthy_z_range"):
            case None:
                return None
            # The comparison is false for nan.
            case [float(low), float(high)] if low < high:
                return low, high
        raise self._error("healthy_z_range must be two floats, in metres, the lower one first")

    def reward(self) -> Reward | None:
        if "reward" not in self._data:
            return None
        reward = self.numbers("reward")
        if set(reward) != {"control_cost", "healthy"}:
            raise self._error("[reward] must hold control_cost and healthy, and nothing else")
        return Reward(**reward)

    def groups(self) -> Mapping[str, tuple[str, ...]]:
        table = self._table("groups", "lists of names, as in legs = [...]", list)
        for name, members in table.items():
            if not re.fullmatch(r"[a-z0-9]+", name):
                raise self._error(f"[groups] {name!r} must consist of lower-case letters and digits")
            if members == []:
                raise self._error(f"[groups] {name} has no members")
        return MappingProxyType({n: self.names(members, f"[groups] {n}") for n, members in table.items()})

    def listing(self, category: str, feet: tuple[str, ...], groups: Mapping[str, tuple[str, ...]]) -> Listing:
        table = self._data.get(category)
        allowed = {"percents", "bodies"} | ({"widen"} if category == "joint" else set())
        if not isinstance(table, dict) or "bodies" not in table or not set(table) <= allowed:
            other = " and ".join(sorted(allowed - {"bodies"}))
            raise self._error(f"[{category}] must hold bodies, may hold {other}, and nothing else")
        percents = table.get("percents", [])
        if not isinstance(percents, list) or not all(
            type(percent) is int and percent > -100 and percent != 0 for percent in percents
        ):
            raise self._error(f"[{category}] percents must be whole numbers above -100, and not 0")
        names = self.names(table["bodies"], f"[{category}] bodies")
        if "feet" in names and not feet:
            raise self._error(f"[{category}] has the body feet, but the page has no key feet")
        bodies = {name.replace("_", ""): feet if name == "feet" else (name,) for name in names}
        if len(bodies) < len(names):
            raise self._error(f"[{category}] bodies has two names of one id")
        widen = self.names(table["widen"], f"[{category}] widen") if "widen" in table else ()
        for name in widen:
            if name not in names:
                raise self._error(f"[{category}] widen has {name!r}, which is not among its bodies")
        # A group belongs to every category that can change all of its members.
        own = {name: members for name, members in groups.items() if set(members) <= set(names)}
        for name in own:
            if name in bodies:
                raise self._error(f"[groups] {name} is the name of a body too")
        return Listing(tuple(percents), MappingProxyType(bodies), MappingProxyType(own), widen)

    def _table(self, key: str, content: str, *types: type) -> dict[str, Any]:
        table = self._data.get(key, {})
        if not isinstance(table, dict) or not all(type(value) in types for value in table.values()):
            raise self._error(f"[{key}] must hold {content}")
        return table

    def names(self, value: Any, key: str, least: int = 1) -> tuple[str, ...]:
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise self._error(f"{key} must be a list of names")
        if len(value) < least:
            raise self._error(f"{key} must have at least one name")
        return tuple(value)

    def _error(self, message: str) -> CatalogueError:
        return CatalogueError(f"{self._name}: {message}")
