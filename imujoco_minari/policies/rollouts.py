"""Episodes: their seeds, rollouts of a policy, and its evaluation.

All random numbers of episode ``i`` under base seed ``s`` come from ``SeedSequence(s, spawn_key=(i,))``. So an
episode does not depend on the process or on the episodes before it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from imujoco_minari.policies import Policy


@dataclass(frozen=True)
class Evaluation:
    """A summary of evaluation episodes.

    Attributes:
        episodes: number of episodes.
        seed: base seed of the episodes.
        deterministic: whether the policy acted deterministically.
        return_mean: mean undiscounted return.
        return_std: standard deviation of the returns.
        return_min: lowest return.
        return_max: highest return.
        length_mean: mean length of an episode, in steps.
    """

    episodes: int
    seed: int
    deterministic: bool
    return_mean: float
    return_std: float
    return_min: float
    return_max: float
    length_mean: float

    @property
    def score(self) -> float:
        """Mean less standard deviation of the returns. It is low for a policy that falls now and then."""
        return self.return_mean - self.return_std

    def asdict(self) -> dict[str, Any]:
        """Return the fields as a dict for JSON."""
        return asdict(self)


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
    rng = np.random.default_rng(seed)
    act, step = policy.act, env.step
    observation, _ = env.reset(seed=seed)
    total, length, ended = 0.0, 0, False
    while not ended:
        observation, reward, terminated, truncated, _ = step(act(observation, rng))
        total += float(reward)
        length += 1
        ended = terminated or truncated
    return total, length


def roll_out_together(
    envs: Sequence[gym.Env[Any, Any]],
    policy: Policy,
    seeds: Sequence[int],
    on_begin: Callable[[int, int], None],
    on_end: Callable[[], None],
) -> None:
    """Run one episode for each seed to its end, in several environments at once.

    The actor computes the actions of all environments in one call, which takes less than a third of the time
    of separate calls. An episode does not depend on the others that run at the same time.

    Args:
        envs: equal environments that end every episode; at most ``policies.LANES``.
        policy: chooses the actions, with ``act_together`` if it has that method.
        seeds: seeds of the episodes, in the order in which they begin.
        on_begin: called before each reset with the numbers of the environment and of the episode.
        on_end: called after each episode.
    """
    act = getattr(policy, "act_together", None) or partial(_act_each, policy)
    waiting = iter(enumerate(seeds))
    observations: list[Any] = [None] * len(envs)
    rngs: list[Any] = [None] * len(envs)

    def begin(lane: int) -> bool:
        episode, seed = next(waiting, (None, 0))
        if episode is None:
            return False
        on_begin(lane, episode)
        observations[lane], _ = envs[lane].reset(seed=seed)
        rngs[lane] = np.random.default_rng(seed)
        return True

    active = [lane for lane in range(len(envs)) if begin(lane)]
    steps = [env.step for env in envs]
    while active:
        actions = act(np.array([observations[lane] for lane in active]), [rngs[lane] for lane in active])
        ended = []
        for lane, action in zip(active, actions, strict=True):
            observations[lane], _, terminated, truncated, _ = steps[lane](action)
            if terminated or truncated:
                ended.append(lane)
        for lane in ended:
            on_end()
            if not begin(lane):
                active.remove(lane)


def _act_each(policy: Policy, observations: Any, rngs: Sequence[np.random.Generator]) -> list[Any]:
    return [policy.act(row, rng) for row, rng in zip(observations, rngs, strict=True)]


def evaluate(
    env: gym.Env[Any, Any],
    policy: Policy,
    *,
    episodes: int = 100,
    seed: int = 0,
    on_episode: Callable[[], None] | None = None,
) -> Evaluation:
    """Roll a policy out for some episodes and return a summary of its returns.

    Args:
        env: an environment that ends every episode, for example by a time limit.
        policy: chooses the actions.
        episodes: number of episodes.
        seed: base seed of the episodes.
        on_episode: called after each episode.

    Example:
        >>> env, policy = make("hopper-base"), load_policy("hopper-base")
        >>> evaluate(env, policy, episodes=10).return_mean
    """
    returns, lengths = np.empty(episodes), np.empty(episodes)
    for episode in range(episodes):
        returns[episode], lengths[episode] = roll_out(env, policy, episode_seed(seed, episode))
        if on_episode is not None:
            on_episode()
    return Evaluation(
        episodes=episodes,
        seed=seed,
        deterministic=policy.deterministic,
        return_mean=float(returns.mean()),
        return_std=float(returns.std()),
        return_min=float(returns.min()),
        return_max=float(returns.max()),
        length_mean=float(lengths.mean()),
    )
