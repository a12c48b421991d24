"""Measures a policy: the returns and the lengths of seeded episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from imujoco_minari.envs.registration import environment_spec
from imujoco_minari.errors import ArgumentError, whole_number
from imujoco_minari.policies.actors import LANES
from imujoco_minari.policies.adapters import batch_act, checked
from imujoco_minari.policies.doors import Array
from imujoco_minari.policies.rollouts import episode_seed, roll_out_together
from imujoco_minari.variants import Variant


@dataclass(frozen=True, eq=False, repr=False)
class Episodes:
    """The results of E episodes of a policy.

    Attributes:
        returns: (E,) float64; the undiscounted returns.
        lengths: (E,) int64; the numbers of steps.
        variants: the id of each episode's variant; empty for an environment that is no variant.
        seed: base seed of the episodes.
        deterministic: whether the policy acted deterministically; None where the policy does not say.
    """

    returns: Array
    lengths: Array
    variants: tuple[str, ...]
    seed: int = 0
    deterministic: bool | None = None

    def asdict(self) -> dict[str, Any]:
        """Return a summary of the returns for JSON, as records of policies and metadata hold it."""
        return {
            "episodes": len(self.returns),
            "seed": self.seed,
            "deterministic": self.deterministic,
            "return_mean": float(self.returns.mean()),
            "return_std": float(self.returns.std()),
            "return_min": float(self.returns.min()),
            "return_max": float(self.returns.max()),
            "length_mean": float(self.lengths.mean()),
        }


def measure(
    env: Variant | str | gym.Env[Any, Any],
    policy: Any,
    episodes: int,
    seed: int,
    on_episode: Callable[[], None] | None = None,
) -> Episodes:
    """Run seeded episodes of a policy; the arguments are those of ``evaluate``.

    Raises:
        ImujocoError: what ``evaluate`` raises.
    """
    whole_number(episodes, "episodes", least=1)
    whole_number(seed, "seed", least=0)
    act = batch_act(policy)
    returns, lengths, variants = np.empty(episodes), np.empty(episodes, np.int64), [""] * episodes
    seeds = [episode_seed(seed, number) for number in range(episodes)]
    with _opened(env, min(LANES, episodes)) as envs:
        act = checked(act, envs[0].action_space.shape or ())
        for number, lane, total_reward, length in roll_out_together(envs, act, seeds):
            returns[number], lengths[number] = total_reward, length
            variants[number] = _variant_id(envs[lane])
            if on_episode is not None:
                on_episode()
    deterministic = getattr(policy, "deterministic", None)
    told = deterministic if isinstance(deterministic, bool) else None
    return Episodes(returns, lengths, tuple(variants), seed, told)


@contextmanager
def _opened(env: Any, lanes: int) -> Iterator[list[gym.Env[Any, Any]]]:
    """Open environments to run side by side, or use the one that is given."""
    if isinstance(env, gym.Env):
        yield [env]
        return
    if not isinstance(env, Variant | str):
        raise ArgumentError(
            f"the environment is a variant, its id or a gymnasium.Env, not {type(env).__name__}; "
            "the policy is the second argument"
        )
    spec = gym.registry[env] if env in gym.registry else environment_spec(env)
    envs: list[gym.Env[Any, Any]] = []
    try:
        envs += (gym.make(spec, disable_env_checker=True) for _ in range(lanes))
        yield envs
    finally:
        for each in envs:
            each.close()


def _variant_id(env: gym.Env[Any, Any]) -> str:
    """Return the id of the variant of the present episode; empty where there are no reference scores."""
    variant = getattr(env.unwrapped, "variant", None)
    # A variant of the original archive has a class of its own, and other references.
    return str(variant) if type(variant) is Variant else ""
