"""Episodes: how they are seeded, how a policy is rolled out, and what it scores.

Every random act of episode ``i`` under base seed ``s`` comes from ``SeedSequence(s, spawn_key=(i,))``,
so an episode is the same whichever process rolls it out, and after whichever other episodes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
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
