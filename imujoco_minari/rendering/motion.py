"""What is drawn: the positions a robot goes through in an episode, by a policy or out of a dataset.

An episode of a dataset is replayed: reset with its recorded seed and stepped by its recorded actions,
as verification does. No picture ever simulates anything by itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
from numpy.typing import NDArray

from imujoco_minari import content, roots
from imujoco_minari.errors import DatasetError, DatasetNotFoundError
from imujoco_minari.policies import Policy
from imujoco_minari.registration import MAX_EPISODE_STEPS, make
from imujoco_minari.rollouts import roll_out
from imujoco_minari.variants import Variant

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Motion:
    """One episode as positions.

    Attributes:
        variant: who moves.
        positions: generalised positions, of shape (steps + 1, nq).
        rewards: of shape (steps,).
        timestep: seconds an environment step takes.
        terminated: whether the robot left its healthy range, rather than that time ran out.
        title: what made it move, in a few words.
        divergence: of a replay, the largest difference from a recorded observation; 0 when exact.
    """

    variant: Variant
    positions: Array
    rewards: Array
    timestep: float
    terminated: bool
    title: str
    divergence: float = 0.0

    @property
    def duration(self) -> float:
        """Simulated seconds."""
        return len(self.rewards) * self.timestep

    @property
    def total(self) -> float:
        """Undiscounted return."""
        return float(self.rewards.sum())

    def until(self, seconds: float | None) -> Motion:
        """Return the first ``seconds`` of it, or all of it."""
        steps = len(self.rewards) if seconds is None else max(1, round(seconds / self.timestep))
        if steps >= len(self.rewards):
            return self
        return replace(
            self, positions=self.positions[: steps + 1], rewards=self.rewards[:steps], terminated=False
        )


class PositionRecorder(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps the positions, rewards and the last flags of the present episode."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.positions: list[Array] = []
        self.rewards: list[float] = []
        self.terminated = False

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode and forget the one before."""
        result = self.env.reset(**kwargs)
        self.positions, self.rewards, self.terminated = [self._position()], [], False
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and keep where that leads."""
        result = self.env.step(action)
        self.positions.append(self._position())
        self.rewards.append(float(result[1]))
        self.terminated = bool(result[2])
        return result

    def motion(self, variant: Variant, title: str, divergence: float = 0.0) -> Motion:
        """Return the present episode."""
        return Motion(
            variant,
            np.array(self.positions),
            np.array(self.rewards),
            float(self.unwrapped.dt),  # type: ignore[attr-defined]
            self.terminated,
            title,
            divergence,
        )

    def _position(self) -> Array:
        return np.array(self.unwrapped.data.qpos)  # type: ignore[attr-defined]


def perform(
    variant: Variant, policy: Policy, *, seed: int = 0, seconds: float | None = None, title: str = ""
) -> Motion:
    """Return an episode of ``policy`` on ``variant``, at most ``seconds`` of it."""
    recorder = PositionRecorder(make(variant, max_episode_steps=_steps(variant, seconds)))
    try:
        roll_out(recorder, policy, seed)
        return recorder.motion(variant, title or f"{policy.algorithm} policy")
    finally:
        recorder.close()


def replay(dataset_id: str, episode: int = 0) -> Motion:
    """Return a recorded episode of a dataset of this package, or of a collection of such.

    Raises:
        DatasetNotFoundError: when the root holds no such dataset, or it no such episode.
        DatasetError: when the episode does not say how it was made.
    """
    variant, seed, actions, observations, tier = _recorded(dataset_id, episode)
    recorder = PositionRecorder(make(variant))
    try:
        observation, _ = recorder.reset(seed=seed)
        divergence = float(np.abs(observation - observations[0]).max())
        for step, action in enumerate(actions):
            observation, _, terminated, truncated, _ = recorder.step(action)
            divergence = max(divergence, float(np.abs(observation - observations[step + 1]).max()))
            if terminated or truncated:
                break
        return recorder.motion(variant, f"{tier}, episode {episode}", divergence)
    finally:
        recorder.close()


def recorded_by(dataset_id: str, episode: int = 0) -> tuple[Variant, str]:
    """Return the variant and the tier of a recorded episode.

    Raises:
        DatasetNotFoundError: when the root holds no such dataset, or it no such episode.
        DatasetError: when the episode does not say how it was made.
    """
    recorded = _recorded(dataset_id, episode)
    return recorded[0], recorded[4]


def _recorded(dataset_id: str, episode: int) -> tuple[Variant, int, Any, Any, str]:
    file_path = content.main_file(roots.dataset_folder(dataset_id) / "data")
    if not file_path.is_file():
        raise DatasetNotFoundError(
            f"{dataset_id} is not in the Minari root, at {roots.datasets_root()}; see `minari list local`"
        )
    try:
        with h5py.File(file_path, "r") as file:
            count = len(file)
            if not 0 <= episode < count:
                raise DatasetNotFoundError(f"{dataset_id} has no episode {episode}; valid: 0 to {count - 1}")
            group = file[f"episode_{episode}"]
            return (
                Variant.parse(str(group.attrs["variant"])),
                int(group.attrs["seed"]),
                group["actions"][()],
                group["observations"][()],
                str(group.attrs.get("tier", "")),
            )
    except (OSError, KeyError) as error:
        if isinstance(error, DatasetNotFoundError):
            raise
        raise DatasetError(f"{dataset_id}: episode {episode} cannot be replayed: {error}") from None


def _steps(variant: Variant, seconds: float | None) -> int:
    if seconds is None:
        return MAX_EPISODE_STEPS
    return max(1, min(MAX_EPISODE_STEPS, round(seconds / timestep(variant))))


def timestep(variant: Variant) -> float:
    """Return the seconds of simulation that a step of ``variant``'s environment takes."""
    env = make(variant)
    try:
        return float(env.unwrapped.dt)  # type: ignore[attr-defined]
    finally:
        env.close()
