"""Motions: the positions of a robot during an episode.

They come from the variant's own environment. Rendering does not simulate anything.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np

from imujoco_minari.envs.mjcf import Floats
from imujoco_minari.envs.registration import make
from imujoco_minari.policies import Policy
from imujoco_minari.policies.rollouts import roll_out
from imujoco_minari.variants import Variant


@dataclass(frozen=True, eq=False)
class Motion:
    """The positions of a robot during one episode.

    Attributes:
        variant: the robot that moves.
        positions: generalised positions, of shape (steps + 1, nq).
        rewards: of shape (steps,).
        timestep: seconds an environment step takes.
        terminated: whether the robot left its healthy range, and did not reach the time limit.
        title: the policy or the recorded episode, in a few words.
        divergence: of a replay, the largest difference from a recorded observation; 0 when exact.
        mjcf: the text of the model, for a variant of the original archive.
    """

    variant: Variant
    positions: Floats
    rewards: Floats
    timestep: float
    terminated: bool
    title: str
    divergence: float = 0.0
    mjcf: str | None = None

    @property
    def duration(self) -> float:
        """Duration in simulated seconds."""
        return len(self.rewards) * self.timestep

    @property
    def total(self) -> float:
        """The undiscounted return."""
        return float(self.rewards.sum())

    def until(self, seconds: float | None) -> Motion:
        """Return the first ``seconds`` of the motion, or all of it for None."""
        steps = len(self.rewards) if seconds is None else max(1, round(seconds / self.timestep))
        if steps >= len(self.rewards):
            return self
        return replace(
            self, positions=self.positions[: steps + 1], rewards=self.rewards[:steps], terminated=False
        )


class PositionRecorder(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper that records the positions, the rewards and the termination of the present episode."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.positions: list[Floats] = []
        self.rewards: list[float] = []
        self.terminated = False

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode and discard the previous one."""
        result = self.env.reset(**kwargs)
        self.positions, self.rewards, self.terminated = [self._position()], [], False
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment and record the new position."""
        result = self.env.step(action)
        self.positions.append(self._position())
        self.rewards.append(float(result[1]))
        self.terminated = bool(result[2])
        return result

    def motion(self, variant: Variant, title: str, divergence: float = 0.0) -> Motion:
        """Return the motion of the present episode."""
        return Motion(
            variant,
            np.array(self.positions),
            np.array(self.rewards),
            float(self.unwrapped.dt),  # type: ignore[attr-defined]
            self.terminated,
            title,
            divergence,
            self.unwrapped.mjcf,  # type: ignore[attr-defined]
        )

    def _position(self) -> Floats:
        return np.array(self.unwrapped.data.qpos)  # type: ignore[attr-defined]


def perform(
    variant: Variant, policy: Policy, *, seed: int = 0, seconds: float | None = None, title: str = ""
) -> Motion:
    """Roll a policy out in a variant and return the motion.

    Args:
        variant: the variant.
        policy: chooses the actions.
        seed: seed of the episode.
        seconds: maximal length in simulated seconds; None for a complete episode.
        title: title of the motion; empty for the policy's algorithm.
    """
    with closing(PositionRecorder(make(variant))) as recorder:
        roll_out(recorder, policy, seed)
        return recorder.motion(variant, title or f"{policy.algorithm} policy").until(seconds)
