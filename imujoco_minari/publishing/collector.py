"""Rollouts recorded by ``minari.DataCollector``: a policy and a variant in, stored episodes out.

A collector writes to the storage that it is given. It knows nothing of the Minari root.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from minari import DataCollector
from minari.data_collector import EpisodeBuffer
from numpy.typing import NDArray

from imujoco_minari.envs.registration import make
from imujoco_minari.policies import LANES, Policy
from imujoco_minari.policies.rollouts import episode_seed, roll_out_together
from imujoco_minari.storage.quiet_file import safe_point
from imujoco_minari.storage.writer import EpisodeStorage, new_storage
from imujoco_minari.variants import Variant


class StorageCollector(DataCollector):  # type: ignore[misc]
    """A ``minari.DataCollector`` that records into the storage that it is given.

    It records what the stock collector records, array for array, of environments whose observations and
    actions are plain arrays. The stock collector checks both spaces at every step and rebuilds its buffer
    through ``jax``: 30 us a step beside the 25 us of a HalfCheetah's physics. This one checks the spaces once
    an episode. It does not record infos.

    Args:
        env: the environment to step.
        storage: where episodes go; several collectors may share an :class:`OrderedStorage`.
    """

    def __init__(self, env: gym.Env[Any, Any], storage: EpisodeStorage | OrderedStorage) -> None:
        self._given = storage
        self._buffer: EpisodeBuffer | None
        super().__init__(env)

    @property
    def datasets_path(self) -> str:
        """The folder of the storage; the stock collector takes a process-wide one."""
        return str(self._given.data_path)

    @datasets_path.setter
    def datasets_path(self, value: str) -> None:
        """Ignore the process-wide root that the stock constructor assigns."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment and record the transition."""
        safe_point()
        observation, reward, terminated, truncated, info = self.env.step(action)
        buffer = self._buffer
        assert buffer is not None, "reset() comes before step()"
        buffer.observations.append(observation)
        buffer.actions.append(action)
        buffer.rewards.append(reward)
        buffer.terminations.append(terminated)
        buffer.truncations.append(truncated)
        if terminated or truncated:
            self._flush_to_storage()
            self._buffer = EpisodeBuffer(self._episode_id, observations=[observation], actions=[])
        return observation, reward, terminated, truncated, info

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; one that was not at its end is stored as truncated."""
        observation, info = super().reset(seed=seed, options=options)
        assert self._buffer is not None
        seed = self._buffer.seed
        self._buffer = EpisodeBuffer(self._episode_id, seed, options, observations=[observation], actions=[])
        return observation, info

    def begin(self, number: int) -> None:
        """Set the number of the episode that the next reset begins."""
        self._episode_id = number

    def forget(self) -> None:
        """Forget the episode that has not ended."""
        self._buffer = None

    def close(self) -> None:
        """Forget the episode that has not ended, and close the environment."""
        self.forget()
        self.env.close()

    def _reset_storage(self) -> None:
        self._episode_id = 0
        self._storage = self._given

    def _flush_to_storage(self) -> None:
        if self._buffer is not None and len(self._buffer):
            # Converted once, for the spaces and for the storage.
            rows = {key: np.asarray(getattr(self._buffer, key)) for key in ("observations", "actions")}
            self._buffer = replace(self._buffer, **rows)
            _warn_outside(self._storage.observation_space, rows["observations"][1:], "Observation")
            _warn_outside(self._storage.action_space, rows["actions"], "Action")
        super()._flush_to_storage()


def _warn_outside(space: gym.Space[Any], rows: NDArray[Any], name: str) -> None:
    """Warn, as the stock collector does, of every row that its space does not contain."""
    if (
        isinstance(space, gym.spaces.Box)
        and rows.shape[1:] == space.shape
        and np.can_cast(rows.dtype, space.dtype)
        and ((rows >= space.low) & (rows <= space.high)).all()
    ):
        return
    for row in rows:
        if not space.contains(row):
            warnings.warn(
                f"{name} is not in {name.lower()} space.\n{name}: {row}\nSpace: {space}", stacklevel=2
            )


def collect(
    variant: Variant,
    policy: Policy,
    episodes: Iterable[int],
    seed: int,
    target: Path,
    attributes: Mapping[str, Any] | None = None,
    on_episode: Callable[[], None] = lambda: None,
) -> None:
    """Record the numbered ``episodes`` of a dataset as a Minari storage in the new folder ``target``.

    Args:
        variant: the variant whose environment is stepped.
        policy: chooses the actions.
        episodes: numbers of the episodes within the dataset; each number seeds its episode.
        seed: base seed of the dataset.
        target: the storage's folder; its parent exists.
        attributes: what every episode carries beside Minari's own attributes.
        on_episode: called after each episode.
    """
    seeds = [episode_seed(seed, episode) for episode in episodes]
    envs = [make(variant) for _ in range(min(LANES, len(seeds)))]
    storage = new_storage(target, envs[0], attributes or {})
    ordered = OrderedStorage(storage)
    collectors = [StorageCollector(env, ordered) for env in envs]
    try:
        roll_out_together(
            collectors, policy, seeds, lambda lane, episode: collectors[lane].begin(episode), on_episode
        )
    finally:
        for collector in collectors:
            collector.close()
        storage.flush()


class OrderedStorage:
    """Takes episodes as they end, and hands them to a storage in the order of their numbers.

    Args:
        storage: where the episodes go.
    """

    def __init__(self, storage: EpisodeStorage) -> None:
        self._storage = storage
        self.data_path = storage.data_path
        self.observation_space, self.action_space = storage.observation_space, storage.action_space
        self._waiting: dict[int, EpisodeBuffer] = {}
        self._next = 0

    def update_episodes(self, episodes: Iterable[EpisodeBuffer]) -> None:
        """Take episodes that have ended."""
        self._waiting |= {buffer.id: buffer for buffer in episodes}
        while self._next in self._waiting:
            self._storage.update_episodes([self._waiting.pop(self._next)])
            self._next += 1
