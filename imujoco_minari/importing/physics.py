"""One step of a robot from any of its observations, by today's simulator.

An observation of these robots begins with their state, without the horizontal position. Nothing depends on
that position, so a recorded step can be simulated again on its own.
"""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from imujoco_minari.variants import specification

Array = NDArray[Any]

# Velocities of the robots that can fall are clipped to this in observations (m/s, rad/s).
_CLIPPED = 10.0


class Physics:
    """The simulator of one variant, set to any observation of it. Use it as a context.

    Args:
        spec: the variant's environment.

    Attributes:
        positions: the number of positions in an observation. The velocities follow them.
        can_terminate: whether the robot can fall.
    """

    def __init__(self, spec: EnvSpec) -> None:
        self._env = gym.make(spec)
        self._raw = cast(Any, self._env.unwrapped)
        self.positions = specification(self._raw.variant.robot).observed_positions
        self._hidden = self._raw.model.nq - self.positions
        self._state = self.positions + self._raw.model.nv
        self.can_terminate = hasattr(self._raw, "is_healthy")
        noise = self._raw._reset_noise_scale
        # The initial velocities of HalfCheetah and Ant are normal with this deviation, all else is uniform.
        self._reset_bounds = noise * np.repeat([1.01, 6.0], [self.positions, self._raw.model.nv])
        self._rest = np.concatenate([self._raw.init_qpos[self._hidden :], self._raw.init_qvel])

    def __enter__(self) -> Physics:
        return self

    def __exit__(self, *_: object) -> None:
        self._env.close()

    def step(self, observation: Array, action: Array) -> tuple[Array, float]:
        """Return the observation and the reward that follow ``action`` in the state of ``observation``."""
        self._set(observation)
        after, reward, *_ = self._raw.step(action)
        return np.asarray(after), float(reward)

    def is_healthy(self, observation: Array) -> bool:
        """Return whether an episode goes on in the state of ``observation``."""
        self._set(observation)
        return bool(getattr(self._raw, "is_healthy", True))

    def looks_reset(self, observations: Array) -> Array:
        """Return, for each of the observations ``(n, size)``, whether an episode could begin with it."""
        offsets = np.abs(observations[:, : self._state] - self._rest)
        return np.asarray((offsets <= self._reset_bounds).all(axis=1))

    def is_whole(self, observations: Array) -> Array:
        """Return, for each of the observations ``(n, size)``, whether no velocity in it is clipped."""
        whole = (np.abs(observations[:, self.positions : self._state]) < _CLIPPED).all(axis=1)
        return np.asarray(whole | (not self.can_terminate))

    def _set(self, observation: Array) -> None:
        self._raw.data.qacc_warmstart[:] = 0.0
        self._raw.set_state(
            np.concatenate([np.zeros(self._hidden), observation[: self.positions]]),
            observation[self.positions : self._state],
        )
