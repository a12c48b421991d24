"""Universal policies: one actor a robot that takes the observation and the context of the variant.

For one variant the context is constant, so its part of the first layer is a constant that is added to the
bias: ``W [o; c] + b = W_o o + (W_c c + b)``. The *folded* policy is an ordinary actor with that bias.
The idea is that of universal policies (Yu et al. 2017).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import fsum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import PolicyError, PolicyNotFoundError
from imujoco_minari.policies.actors import Actor
from imujoco_minari.policies.doors import Array
from imujoco_minari.policies.files import read_actor
from imujoco_minari.policies.records import check_measured, errors_of, read_object
from imujoco_minari.variants import Variant, specification
from imujoco_minari.variants.context import parameters

FIRST_WEIGHT, FIRST_BIAS = "latent_pi.0.weight", "latent_pi.0.bias"


def universal_name(robot: str) -> str:
    """Return the name of a robot's universal policy, ``<robot>-universal``, as in its files."""
    return f"{robot}-universal"


def whole_context(variant: Variant) -> NDArray[np.float64]:
    """Return the context of a variant over all parameters of its robot's page.

    A group of bodies is no parameter of its own: a change of a group is a change of each of its bodies.

    Returns:
        Percent / 100 of each of :func:`~imujoco_minari.variants.context.parameters`, in that order.

    Example:
        >>> whole_context(Variant.parse("hopper-massdec_25_leggeom"))[:4]
        array([ 0.  ,  0.  , -0.25,  0.  ])
    """
    changes = {
        (change.category, name): change.percent
        for change in variant.changes
        for name in change.mjcf_names(variant.robot)
    }
    vector = []
    for parameter in parameters(variant.robot):
        category, _, body = parameter.partition("/")
        names = specification(variant.robot).categories[category].names(body)
        vector.append(fsum(changes.get((category, name), 0) for name in names) / len(names) / 100)
    return np.array(vector, dtype=np.float64)


@dataclass(frozen=True, eq=False, repr=False)
class UniversalPolicy:
    """An actor whose inputs are the observation and the context.

    Attributes:
        robot: the robot.
        actor: the actor over observation and context.
        low: lowest value of each parameter in training; shape (parameters,).
        high: highest value of each parameter in training; shape (parameters,).
        record: how it was made, for its JSON file.
        deterministic: whether folded policies take the mode of their distribution, or a sample.

    Raises:
        PolicyError: when the actor does not take the robot's observation and context.
    """

    robot: str
    actor: Actor
    low: Array
    high: Array
    record: Mapping[str, Any]
    deterministic: bool = True

    def __post_init__(self) -> None:
        page, count = specification(self.robot), len(parameters(self.robot))
        sizes = self.actor.observation_size, self.actor.action_size
        if sizes != (page.observation_size + count, page.action_size) or len(self.low) != count:
            raise PolicyError(
                f"the universal policy maps {sizes[0]} numbers to {sizes[1]}, but {self.robot} has "
                f"{page.observation_size} observations, {count} parameters and {page.action_size} actions"
            )

    def __repr__(self) -> str:
        return f"UniversalPolicy({self.robot}, {len(self.low)} parameters, {self.actor!r})"

    @property
    def algorithm(self) -> str:
        """Name of the algorithm that trained it."""
        return self.actor.algorithm

    @property
    def sha256(self) -> str:
        """Digest of the weights."""
        return self.actor.sha256

    def context(self, variant: Variant) -> NDArray[np.float64]:
        """Return the context of a variant, with each value inside the range that training has seen."""
        return np.clip(whole_context(variant), self.low, self.high)

    def told(self, variant: Variant) -> dict[str, float]:
        """Return the context as parameter -> percent, without the parameters that are not changed."""
        named = zip(parameters(self.robot), self.context(variant).tolist(), strict=True)
        return {name: round(100 * value, 2) for name, value in named if value}

    def fold(self, variant: Variant) -> Actor:
        """Return the policy that is told this variant: an actor of the observation alone."""
        return self.fold_context(self.context(variant))

    def fold_context(self, context: Array) -> Actor:
        """Return the policy that is told a context (parameters,): an actor of the observation alone."""
        weights = dict(self.actor.weights)
        size = specification(self.robot).observation_size
        first = weights[FIRST_WEIGHT].astype(np.float64)
        bias = weights[FIRST_BIAS] + first[:, size:] @ context
        weights |= {
            FIRST_WEIGHT: np.ascontiguousarray(weights[FIRST_WEIGHT][:, :size], np.float32),
            FIRST_BIAS: bias.astype(np.float32),
        }
        return Actor(weights, self.algorithm, self.deterministic).for_robot(self.robot)


def read_universal(weights: Path) -> UniversalPolicy:
    """Read a universal policy from its ``.safetensors`` and the ``.json`` beside it.

    Raises:
        PolicyNotFoundError: if one of the files is missing.
        PolicyError: if they hold no universal policy.
    """
    path = weights.with_suffix(".json")
    for file in (weights, path):
        if not file.is_file():
            raise PolicyNotFoundError(f"no universal policy: {file} is missing")
    # A file that is replaced by a new one must be read again.
    return _read(weights, path, weights.stat().st_mtime_ns, path.stat().st_mtime_ns)


def universal_of_record(actor: Actor, record: Mapping[str, Any]) -> UniversalPolicy:
    """Return the universal policy with a record, which states the robot and the ranges of the parameters.

    Raises:
        ValueError: if a range is not one.
        PolicyError: if the actor does not fit the robot.
    """
    ranges = [record["ranges"][name] for name in parameters(record["robot"])]
    low, high = np.array(ranges, float).reshape(len(ranges), 2).T / 100
    if not (np.isfinite([low, high]).all() and (low <= high).all()):
        raise ValueError("a range must be two finite numbers, the lower one first")
    return UniversalPolicy(record["robot"], actor, low, high, record)


@lru_cache(maxsize=8)
def _read(weights: Path, path: Path, *changed: int) -> UniversalPolicy:
    with errors_of(path, "the record of a universal policy"):
        record = read_object(path)
        if not isinstance(record["measured"], dict) or not isinstance(record["algorithm"], str):
            raise ValueError("measured must be a table and algorithm a text")
        for each in record["measured"].values():
            check_measured(each)
        return universal_of_record(read_actor(weights, algorithm=record["algorithm"]), record)
