"""Rollouts recorded by ``minari.DataCollector``: a policy and a variant in, stored episodes out.

A collector writes to a folder that it is given; where datasets live, and when one becomes visible,
is :mod:`imujoco_minari.publishing.publisher`'s.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, closing
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
from imujoco_minari.storage.writer import EpisodeStorage
from imujoco_minari.variants import Variant


class FolderCollector(DataCollector):  # type: ignore[misc]
    """A ``minari.DataCollector`` that records into one folder and leaves it there.

    It records what the stock collector does, array for array, of environments whose observations and
    actions are plain arrays, with less work a step: the stock one asks at every step whether observation
    and action lie in their spaces, and rebuilds its buffer through ``jax``, 30 us beside the 25 us of a
    HalfCheetah's physics. Here the spaces are asked once an episode. Infos are not recorded.

    The stock collector also takes its place from the process-wide ``MINARI_DATASETS_PATH`` and, in
    ``create_dataset``, moves files one by one into a dataset that is already visible.

    Args:
        env: what is stepped.
        folder: where the storage is made.
        attributes: what every episode carries beside Minari's own attributes.
    """

    def __init__(
        self, env: gym.Env[Any, Any], folder: Path, attributes: Mapping[str, Any] | None = None
    ) -> None:
        self._folder = str(folder)
        self._attributes = dict(attributes or {})
        self._buffer: EpisodeBuffer | None
        self._storage: Any
        super().__init__(env)

    @property
    def datasets_path(self) -> str:
        """The folder in which the collector makes its storage."""
        return self._folder

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

    def keep(self, target: Path) -> None:
        """Close the environment and move ``main_data.hdf5`` and ``metadata.json`` to ``target``."""
        self._flush_to_storage()
        self._storage.flush()
        Path(self._storage.data_path).rename(target)
        self.close()

    def close(self) -> None:
        """Close the environment and remove what was not kept."""
        self._buffer = None
        self._storage.flush()
        self.env.close()
        self._tmp_dir.cleanup()

    def _reset_storage(self) -> None:
        if hasattr(self, "_tmp_dir"):
            self._tmp_dir.cleanup()
        super()._reset_storage()
        self._storage = EpisodeStorage(
            self._storage.data_path, self._storage.observation_space, self._storage.action_space
        )
        self._storage.attributes = self._attributes

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
    on_episode: Callable[[], None] | None = None,
) -> None:
    """Record the numbered ``episodes`` of a dataset as a Minari storage in the new folder ``target``.

    Args:
        variant: whose environment is stepped.
        policy: chooses the actions.
        episodes: numbers of the episodes within the dataset; each is seeded by its own.
        seed: base seed of the dataset.
        target: the storage's folder; its parent exists.
        attributes: what every episode carries beside Minari's own attributes.
        on_episode: called after each episode.
    """
    seeds = [episode_seed(seed, episode) for episode in episodes]
    with ExitStack() as opened:
        lanes = [
            opened.enter_context(closing(FolderCollector(make(variant), target.parent, attributes)))
            for _ in range(min(LANES, len(seeds)))
        ]
        first = lanes[0]
        storage = first._storage
        in_order = _InOrder(storage)
        for lane in lanes:
            lane._storage = in_order

        def begin(lane: int, episode: int) -> None:
            lanes[lane]._episode_id = episode

        roll_out_together(lanes, policy, seeds, begin, on_episode or _nothing)
        first._storage = storage
        first.keep(target)


def _nothing() -> None:
    """Be called after each episode when no one wants to be."""


class _InOrder:
    """Takes episodes as they end, and hands them to a storage in the order of their numbers."""

    def __init__(self, storage: EpisodeStorage) -> None:
        self._storage = storage
        self.observation_space, self.action_space = storage.observation_space, storage.action_space
        self._waiting: dict[int, EpisodeBuffer] = {}
        self._next = 0

    def update_episodes(self, episodes: Iterable[EpisodeBuffer]) -> None:
        self._waiting |= {buffer.id: buffer for buffer in episodes}
        while self._next in self._waiting:
            self._storage.update_episodes([self._waiting.pop(self._next)])
            self._next += 1

    def flush(self) -> None:
        self._storage.flush()
