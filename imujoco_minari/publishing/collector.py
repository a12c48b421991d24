"""Collectors: they roll a policy out in a variant and record the episodes.

A collector does not know the Minari root.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from minari.data_collector import EpisodeBuffer
from numpy.typing import NDArray

from imujoco_minari.policies import LANES, Policy
from imujoco_minari.policies.adapters import batch_act, checked
from imujoco_minari.policies.rollouts import episode_seed, roll_out_together
from imujoco_minari.policies.universal import UniversalPolicy
from imujoco_minari.storage.quiet_file import safe_point
from imujoco_minari.storage.writer import Attributes, EpisodeWriter
from imujoco_minari.variants import Variant

OnEpisode = Callable[[], None]


class Collector(gym.Wrapper[Any, Any, Any, Any]):
    """Records whole episodes: the arrays that ``minari.DataCollector`` records.

    The stock collector checks both spaces at every step and rebuilds its buffer through ``jax``. That takes
    30 us per step, where a HalfCheetah's physics take 25 us. This collector checks the spaces once per
    episode. It is for observations and actions that are plain arrays, and records no infos.

    Args:
        env: the environment to step.
        writer: writes the episodes. Several collectors may share one.
        on_episode: called after each episode.
    """

    def __init__(
        self, env: gym.Env[Any, Any], writer: EpisodeWriter, on_episode: OnEpisode = lambda: None
    ) -> None:
        super().__init__(env)
        self._writer, self._on_episode = writer, on_episode
        self._buffer: EpisodeBuffer | None = None
        self._number = 0

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
            self._store(buffer)
        return observation, reward, terminated, truncated, info

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode. An unfinished episode is discarded, because its replay would not end either."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._buffer = EpisodeBuffer(self._number, seed, observations=[observation], actions=[])
        return observation, info

    def begin(self, number: int) -> None:
        """Set the number of the episode that starts at the next reset."""
        self._number = number

    def _store(self, buffer: EpisodeBuffer) -> None:
        # One conversion serves both the spaces and the writer.
        observations, actions = np.asarray(buffer.observations), np.asarray(buffer.actions)
        _warn_if_outside(self._writer.observation_space, observations, "Observation")
        _warn_if_outside(self._writer.action_space, actions, "Action")
        self._writer.add(replace(buffer, observations=observations, actions=actions))
        self._buffer = None
        self._number += 1
        self._on_episode()


def _warn_if_outside(space: gym.spaces.Box, rows: NDArray[Any], name: str) -> None:
    """Warn about every row outside its space, as the stock collector does."""
    inside = ((rows >= space.low) & (rows <= space.high)).all(axis=1)
    for row in rows[~inside]:
        warnings.warn(f"{name} is not in {name.lower()} space.\n{name}: {row}\nSpace: {space}", stacklevel=2)


def collect(
    spec: EnvSpec,
    policy: Policy | UniversalPolicy,
    episodes: Iterable[int],
    seed: int,
    target: Path,
    attributes: Attributes = lambda seed: {},
    on_episode: OnEpisode = lambda: None,
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
    universal = policy if isinstance(policy, UniversalPolicy) else None
    with EpisodeWriter(target, spec, attributes) as writer, ExitStack() as stack:
        collectors = [
            stack.enter_context(Collector(gym.make(spec), writer, on_episode))
            for _ in range(1 if universal else min(LANES, len(seeds)))
        ]
        acting = batch_act(universal.fold(Variant(universal.robot)) if universal else policy)
        act = checked(lambda seen, rngs: acting(seen, rngs), writer.action_space.shape or ())

        def begin(lane: int, number: int) -> None:
            nonlocal acting
            collectors[lane].begin(number)
            if universal:
                acting = universal.fold(Variant.parse(attributes(seeds[number])["variant"])).act_together

        for _ in roll_out_together(collectors, act, seeds, begin):
            pass
