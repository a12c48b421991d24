"""The random policy: uniformly random actions."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from imujoco_minari.errors import ArgumentError
from imujoco_minari.policies.doors import Array, Doors, given
from imujoco_minari.variants import specification


@dataclass(frozen=True)
class RandomPolicy(Doors):
    """Draws actions uniformly from the action space.

    Attributes:
        action_size: length of an action.
        algorithm: ``random``.
        deterministic: False.
        bound: largest absolute value of an action's entry.
    """

    action_size: int
    algorithm: str = "random"
    deterministic: bool = False
    bound: float = 1.0

    @property
    def sha256(self) -> str:
        """Digest of the distribution's name: a random policy has no weights."""
        return hashlib.sha256(f"uniform [-{self.bound:g}, {self.bound:g}]".encode()).hexdigest()

    def act(self, observation: Array, rng: np.random.Generator | None = None) -> Array:
        """Return a uniformly random action for an observation, or one for each of a batch.

        Raises:
            ArgumentError: when there is no ``rng``.
        """
        shape = (*np.shape(observation)[:-1], self.action_size)
        return given(rng).uniform(-self.bound, self.bound, shape).astype(np.float32)

    def changed(self, deterministic: bool) -> RandomPolicy:
        """Return this policy.

        Raises:
            ArgumentError: when it should act deterministically.
        """
        if deterministic:
            raise ArgumentError("a random policy has no deterministic action; give deterministic=False")
        return self


def random_policy(robot: str) -> RandomPolicy:
    """Return the random policy of a robot.

    Raises:
        VariantError: when there is no such robot.
    """
    page = specification(robot)
    return RandomPolicy(page.action_size, bound=page.action_bound)
