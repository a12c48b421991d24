"""Environments that are stepped together without end: each lane runs one episode after the other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from imujoco_minari.envs.registration import make
from imujoco_minari.policies import Array
from imujoco_minari.policies.rollouts import episode_seed
from imujoco_minari.policies.universal import whole_context
from imujoco_minari.variants import Variant, specification
from imujoco_minari.variants.context import parameters

Wrap = Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]


class Stepped(NamedTuple):
    """The result of one step in every lane.

    Attributes:
        following: observations after the step, before any reset; shape (lanes, observation size).
        rewards: shape (lanes,).
        terminated: whether the episode ended by termination; shape (lanes,).
        ended: variant and return of each episode that ended.
    """

    following: Array
    rewards: Array
    terminated: Array
    ended: list[tuple[Variant, float]]


class Lanes:
    """Environments of one robot, stepped together.

    Args:
        robot: the robot.
        count: number of lanes.
        choose: the number of a lane and of an episode -> the variant of that episode.
        seed: base seed of the episodes.
        told: whether inputs have the context of the variant, after the observation.
        wrap: wraps each new environment, for example to record it.

    Attributes:
        episodes: number of episodes begun. It seeds the next episode.
        observations: present observations, float64; shape (lanes, observation size).
        contexts: of the present variants, float32; shape (lanes, parameters), or (lanes, 0) if not told.
    """

    def __init__(
        self,
        robot: str,
        count: int,
        choose: Callable[[int, int], Variant],
        seed: int,
        *,
        told: bool,
        wrap: Wrap | None = None,
    ) -> None:
        page = specification(robot)
        self._choose, self._seed, self._told, self._wrap = choose, seed, told, wrap
        self._bound, self.episodes = page.action_bound, 0
        self._envs: list[Any] = [None] * count
        self._totals = np.zeros(count)
        self.observations = np.zeros((count, page.observation_size))
        self.contexts = np.zeros((count, len(parameters(robot)) if told else 0), np.float32)

    @property
    def inputs(self) -> Array:
        """The inputs of a policy: observations and contexts, float32."""
        return np.concatenate([self.observations, self.contexts], axis=1, dtype=np.float32)

    def restart(self) -> None:
        """Begin a new episode in every lane."""
        for lane in range(len(self._envs)):
            self._begin(lane)

    def step(self, actions: Array) -> Stepped:
        """Act in every lane. A lane whose episode has ended begins the next one.

        Args:
            actions: in [-1, 1]; shape (lanes, action size).
        """
        following, ended = np.empty_like(self.observations), []
        rewards, terminations = np.empty(len(actions)), np.zeros(len(actions), bool)
        for lane, action in enumerate(actions * self._bound):
            following[lane], rewards[lane], terminated, truncated, _ = self._envs[lane].step(action)
            self._totals[lane] += rewards[lane]
            terminations[lane] = terminated
            if terminated or truncated:
                ended.append((self._envs[lane].unwrapped.variant, float(self._totals[lane])))
                self._begin(lane)
            else:
                self.observations[lane] = following[lane]
        return Stepped(following, rewards, terminations, ended)

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs:
            if env is not None:
                env.close()

    def _begin(self, lane: int) -> None:
        self.episodes += 1
        variant, before = self._choose(lane, self.episodes), self._envs[lane]
        if before is None or variant != before.unwrapped.variant:
            if before is not None:
                before.close()
            env = make(variant, disable_env_checker=True)
            self._envs[lane] = env if self._wrap is None else self._wrap(env)
            if self._told:
                self.contexts[lane] = whole_context(variant)
        self._totals[lane] = 0.0
        self.observations[lane], _ = self._envs[lane].reset(seed=episode_seed(self._seed, self.episodes))
