"""Episodes: how they are seeded, how a policy is rolled out, and what it scores.

Every random act of episode ``i`` under base seed ``s`` comes from ``SeedSequence(s, spawn_key=(i,))``,
so an episode is the same whichever process rolls it out, and after whichever other episodes.
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
    """Undiscounted returns and lengths of evaluation episodes, summarised."""

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
        """Mean less standard deviation of the returns: what a policy that falls now and then has less of."""
        return self.return_mean - self.return_std

    def asdict(self) -> dict[str, Any]:
        """Return the fields as a dict for JSON."""
        return asdict(self)


def episode_seed(seed: int, episode: int) -> int:
    """Return the seed (32 bits) that resets episode ``episode`` of a dataset made with base seed ``seed``."""
    return int(np.random.SeedSequence(seed, spawn_key=(episode,)).generate_state(1)[0])


def roll_out(env: gym.Env[Any, Any], policy: Policy, seed: int) -> tuple[float, int]:
    """Run one episode of ``policy`` to its end and return its return and its length (steps).

    Args:
        env: ends every episode by itself, as ``gymnasium.make`` with a time limit does.
        policy: chooses the actions.
        seed: resets the environment and, where the policy is random, seeds its draws.
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
    """Run one episode a seed, as many at once as there are environments, each to its end.

    An actor's weights pass through the processor's cache once for all instead of once for each, which
    costs less than a third. What an episode holds does not depend on which others run beside it.

    Args:
        envs: equal environments that end every episode by themselves; at most ``policies.LANES``.
        policy: chooses the actions, by ``act_together`` if it has that.
        seeds: of the episodes, which begin in this order.
        on_begin: called with the numbers of environment and episode before each is reset.
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
    """Roll ``policy`` out for ``episodes`` seeded episodes and return the summary of what it scores."""
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
