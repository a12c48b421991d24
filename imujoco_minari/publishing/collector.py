"""Collectors: they roll a policy out in a variant and record the episodes by ``minari.DataCollector``.

A collector writes to the storage that it is given. It does not know the Minari root.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from minari import DataCollector
from minari.data_collector import EpisodeBuffer
from numpy.typing import NDArray

from imujoco_minari.policies import LANES, Policy
from imujoco_minari.policies.adapters import batch_act, checked
from imujoco_minari.policies.rollouts import episode_seed, roll_out_together
from imujoco_minari.policies.universal import ToldPolicy, UniversalPolicy
from imujoco_minari.storage.quiet_file import safe_point
from imujoco_minari.storage.writer import EpisodeStorage, new_storage
from imujoco_minari.variants import Variant

# Seed of an episode -> its attributes.
Attributes = Callable[[int], Mapping[str, Any]]


class StorageCollector(DataCollector):  # type: ignore[misc]
    """A ``minari.DataCollector`` that records into the storage that it is given.

    It records the same arrays as the stock collector, for environments whose observations and actions are
    plain arrays. The stock collector checks both spaces at every step and rebuilds its buffer through
    ``jax``. That takes 30 us per step, where a HalfCheetah's physics take 25 us. This collector checks the
    spaces once per episode. It does not record infos.

    Args:
        env: the environment to step.
        storage: the storage of the episodes. Several collectors may share one.
    """

    def __init__(self, env: gym.Env[Any, Any], storage: EpisodeStorage) -> None:
        self._target_storage = storage
        self._buffer: EpisodeBuffer | None
        super().__init__(env)

    @property
    def datasets_path(self) -> str:
        """The folder of the storage. The stock collector uses one folder for the whole process."""
        return str(self._target_storage.data_path)

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
        """Begin an episode. An unfinished episode is stored as truncated."""
        observation, info = super().reset(seed=seed, options=options)
        assert self._buffer is not None
        seed = self._buffer.seed
        self._buffer = EpisodeBuffer(self._episode_id, seed, options, observations=[observation], actions=[])
        return observation, info

    def begin(self, number: int) -> None:
        """Set the number of the episode that starts at the next reset."""
        self._episode_id = number

    def forget(self) -> None:
        """Discard the unfinished episode."""
        self._buffer = None

    def close(self) -> None:
        """Discard the unfinished episode and close the environment."""
        self.forget()
        self.env.close()

    def _reset_storage(self) -> None:
        self._episode_id = 0
        self._storage = self._target_storage

    def _flush_to_storage(self) -> None:
        if self._buffer is not None and len(self._buffer):
            # One conversion serves both the spaces and the storage.
            rows = {key: np.asarray(getattr(self._buffer, key)) for key in ("observations", "actions")}
            self._buffer = replace(self._buffer, **rows)
            _warn_if_outside(self._storage.observation_space, rows["observations"][1:], "Observation")
            _warn_if_outside(self._storage.action_space, rows["actions"], "Action")
        super()._flush_to_storage()


def _warn_if_outside(space: gym.Space[Any], rows: NDArray[Any], name: str) -> None:
    """Warn about every row outside its space, as the stock collector does."""
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
    spec: EnvSpec,
    policy: Policy | UniversalPolicy,
    episodes: Iterable[int],
    seed: int,
    target: Path,
    attributes: Attributes = lambda seed: {},
    on_episode: Callable[[], None] = lambda: None,
) -> None:
    """Record episodes of a dataset as a Minari storage in a new folder.

    Args:
        spec: specification of the environment to step.
        policy: chooses the actions. A universal policy is told the variant of each episode.
        episodes: numbers of the episodes in the dataset. Each number seeds its episode.
        seed: base seed of the dataset.
        target: the new folder of the storage. Its parent must exist.
        attributes: returns the attributes of the episode with a seed, in addition to Minari's own.
        on_episode: called after each episode.
    """
    seeds = [episode_seed(seed, episode) for episode in episodes]
    # A universal policy is told another variant in each episode, so one episode runs at a time.
    told = ToldPolicy(policy) if isinstance(policy, UniversalPolicy) else None
    envs = [gym.make(spec) for _ in range(1 if told else min(LANES, len(seeds)))]
    storage = new_storage(target, envs[0], {})
    storage.attributes = attributes
    collectors = [StorageCollector(env, storage) for env in envs]
    act = checked(batch_act(told or policy), envs[0].action_space.shape or ())

    def begin(lane: int, number: int) -> None:
        collectors[lane].begin(number)
        if told is not None:
            told.tell(Variant.parse(attributes(seeds[number])["variant"]))

    try:
        for _ in roll_out_together(collectors, act, seeds, begin):
            on_episode()
    finally:
        for collector in collectors:
            collector.close()
        storage.flush()
