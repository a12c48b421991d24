"""One step of a robot from any of its observations, by today's simulator.

An observation of these robots begins with their whole state but for the horizontal position, which nothing
depends on, so a recorded step can be simulated again on its own. This compares imported data with the
variant's model. It also gives the observation after the last step, where a file lacks it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from imujoco_minari.variants import specification

Array = NDArray[Any]

# Velocities of the robots that can fall are clipped to this in observations (m/s, rad/s).
CLIPPED = 10.0


@dataclass(frozen=True)
class Fidelity:
    """How far recorded steps are from the same steps simulated today.

    Each step has a largest deviation of a position (m, rad) and of a velocity (m/s, rad/s), and a deviation
    of the reward. The fields are the medians and maxima over ``rows`` steps, or None without such values.
    """

    rows: int
    position_median: float | None = None
    position_max: float | None = None
    velocity_median: float | None = None
    velocity_max: float | None = None
    reward_median: float | None = None
    reward_max: float | None = None

    def asdict(self) -> dict[str, Any]:
        """Return the fields as a dict for JSON."""
        return asdict(self)


class Physics:
    """The simulator of one variant, set to any observation of it. Close it, or use it as a context.

    Args:
        spec: the variant's environment.
    """

    def __init__(self, spec: EnvSpec) -> None:
        self._env = gym.make(spec)
        self._raw = cast(Any, self._env.unwrapped)
        self.positions = specification(self._raw.variant.robot).observed_positions
        self._hidden = self._raw.model.nq - self.positions
        self.can_terminate = hasattr(self._raw, "is_healthy")
        noise = self._raw._reset_noise_scale
        # HalfCheetah's initial velocities are normal with that deviation, the others' are uniform.
        spread = 1.01 if self.can_terminate else 6.0
        self._reset_bounds = np.concatenate(
            [np.full(self.positions, 1.01 * noise), np.full(self._raw.model.nv, spread * noise)]
        )
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
        return np.asarray(
            (np.abs(observations[:, : len(self._rest)] - self._rest) <= self._reset_bounds).all(axis=1)
        )

    def fidelity(self, before: Array, actions: Array, after: Array, rewards: Array | None) -> Fidelity:
        """Compare recorded steps with the same steps simulated; states that are not whole are left out.

        Args:
            before: observations ``(n, size)``.
            actions: what was done in them, ``(n, actions)``.
            after: the observations that followed.
            rewards: what was given for them, ``(n,)``, or None.
        """
        velocities = np.abs(before[:, self.positions : self.positions + self._raw.model.nv])
        whole = np.flatnonzero((velocities < CLIPPED).all(axis=1) | (not self.can_terminate))
        if not len(whole):
            return Fidelity(0)
        observed, given = zip(*(self.step(before[row], actions[row]) for row in whole), strict=True)
        errors = np.abs(np.array(observed) - after[whole])
        position, velocity = errors[:, : self.positions].max(axis=1), errors[:, self.positions :].max(axis=1)
        columns = [position, velocity]
        if rewards is not None:
            columns.append(np.abs(np.array(given) - rewards[whole]))
        return Fidelity(len(whole), *(float(f(column)) for column in columns for f in (np.median, np.max)))

    def _set(self, observation: Array) -> None:
        self._raw.data.qacc_warmstart[:] = 0.0
        self._raw.set_state(
            np.concatenate([np.zeros(self._hidden), observation[: self.positions]]),
            observation[self.positions : self.positions + self._raw.model.nv],
        )
