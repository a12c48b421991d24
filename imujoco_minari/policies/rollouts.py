"""Episodes: their seeds, and rollouts of a policy.

All random numbers of episode ``i`` under base seed ``s`` come from ``SeedSequence(s, spawn_key=(i,))``. So an
episode does not depend on the process or on the episodes before it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from threadpoolctl import threadpool_limits

from imujoco_minari.policies.actors import Policy
from imujoco_minari.policies.adapters import BatchAct, batch_act


class EndedEpisode(NamedTuple):
    """An episode that has ended.

    Attributes:
        number: place of its seed among the seeds.
        lane: number of the environment that it ran in.
        total_reward: its undiscounted return.
        length: its number of steps.
    """

    number: int
    lane: int
    total_reward: float
    length: int


def episode_seed(seed: int, episode: int) -> int:
    """Return the 32-bit seed of one episode of a dataset.

    Args:
        seed: base seed of the dataset.
        episode: number of the episode.
    """
    return int(np.random.SeedSequence(seed, spawn_key=(episode,)).generate_state(1)[0])


def roll_out(env: gym.Env[Any, Any], policy: Policy, seed: int) -> tuple[float, int]:
    """Run one episode of ``policy`` to its end and return its return and its length (steps).

    Args:
        env: an environment that ends every episode, for example by a time limit.
        policy: chooses the actions.
        seed: seed of the reset and of a random policy.
    """
    (ended,) = roll_out_together([env], batch_act(policy), [seed])
    return ended.total_reward, ended.length


def roll_out_together(
    envs: Sequence[gym.Env[Any, Any]],
    act: BatchAct,
    seeds: Sequence[int],
    on_begin: Callable[[int, int], None] = lambda lane, number: None,
) -> Iterator[EndedEpisode]:
    """Run one episode for each seed to its end, in several environments at once. Yield each when it ends.

    The policy computes the actions of all environments in one call. For this package's actor that takes less
    than a third of the time of separate calls, and an episode does not depend on those that run beside it.

    Args:
        envs: equal environments that end every episode.
        act: computes the actions: :func:`~imujoco_minari.policies.adapters.batch_act` of a policy.
        seeds: seeds of the episodes, in the order in which they begin.
        on_begin: called before each reset with the numbers of the environment and of the episode.
    """
    waiting = iter(enumerate(seeds))
    numbers, lengths = [0] * len(envs), [0] * len(envs)
    totals = [0.0] * len(envs)
    observations: list[Any] = [None] * len(envs)
    rngs: list[Any] = [None] * len(envs)

    def begin(lane: int) -> bool:
        number, seed = next(waiting, (None, 0))
        if number is None:
            return False
        on_begin(lane, number)
        observations[lane], _ = envs[lane].reset(seed=seed)
        rngs[lane] = np.random.default_rng(seed)
        numbers[lane], totals[lane], lengths[lane] = number, 0.0, 0
        return True

    active = [lane for lane in range(len(envs)) if begin(lane)]
    steps = [env.step for env in envs]
    # On busy cores, BLAS's threads wait for each other: an action of 16 environments takes 100 times as long.
    with threadpool_limits(limits=1, user_api="blas"):
        while active:
            actions = act(np.array([observations[lane] for lane in active]), [rngs[lane] for lane in active])
            ended = []
            for lane, action in zip(active, actions, strict=True):
                observations[lane], reward, terminated, truncated, _ = steps[lane](action)
                totals[lane] += float(reward)
                lengths[lane] += 1
                if terminated or truncated:
                    ended.append(lane)
            for lane in ended:
                yield EndedEpisode(numbers[lane], lane, totals[lane], lengths[lane])
                if not begin(lane):
                    active.remove(lane)
