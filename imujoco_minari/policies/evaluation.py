"""Evaluation of a policy: the return, the length and the normalised score of each of its episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np

from imujoco_minari.envs.registration import environment_spec
from imujoco_minari.errors import ArgumentError, VariantError, whole_number
from imujoco_minari.policies.actors import LANES
from imujoco_minari.policies.adapters import batch_act, checked
from imujoco_minari.policies.aggregates import bootstrap_interval, interquartile_mean
from imujoco_minari.policies.doors import Array
from imujoco_minari.policies.rollouts import episode_seed, roll_out_together
from imujoco_minari.variants import Variant


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation:
    """The results of E episodes of a policy, with statistics and normalised scores.

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

    def __repr__(self) -> str:
        low, high = self.return_interval
        names = list(dict.fromkeys(self.variants))
        where = f" on {names[0] if len(names) == 1 else f'{len(names)} variants'}" if any(names) else ""
        return (
            f"Evaluation({self.episodes} episodes{where}: "
            f"return {self.return_mean:.1f} ± {self.return_std:.1f}, "
            f"interquartile mean {self.return_iqm:.1f} [{low:.1f}, {high:.1f}], "
            f"length {self.length_mean:.1f})"
        )

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.returns)

    @property
    def return_mean(self) -> float:
        """Mean return."""
        return float(self.returns.mean())

    @property
    def return_std(self) -> float:
        """Standard deviation of the returns."""
        return float(self.returns.std())

    @property
    def return_min(self) -> float:
        """Lowest return."""
        return float(self.returns.min())

    @property
    def return_max(self) -> float:
        """Highest return."""
        return float(self.returns.max())

    @property
    def return_iqm(self) -> float:
        """Interquartile mean of the returns."""
        return interquartile_mean(self.returns)

    @property
    def return_interval(self) -> tuple[float, float]:
        """95 % bootstrap interval of the interquartile mean of the returns."""
        return bootstrap_interval(self.returns)

    @property
    def length_mean(self) -> float:
        """Mean length of an episode, in steps."""
        return float(self.lengths.mean())

    def asdict(self) -> dict[str, Any]:
        """Return a summary of the returns for JSON, as records of policies and metadata hold it."""
        return {
            "episodes": self.episodes,
            "seed": self.seed,
            "deterministic": self.deterministic,
            "return_mean": self.return_mean,
            "return_std": self.return_std,
            "return_min": self.return_min,
            "return_max": self.return_max,
            "length_mean": self.length_mean,
        }

    @cached_property
    def scores(self) -> Array:
        """(E,) float64; the normalised scores: 0 for the random policy of the variant, 1 for its expert.

        Raises:
            VariantError: when the environment is no variant.
            PolicyNotFoundError: when a variant has no expert.
        """
        # Reference scores are evaluations too.
        from imujoco_minari.policies.references import normalized_score

        if not all(self.variants):
            raise VariantError("the environment is no variant, so its returns have no reference scores")
        return normalized_score(self.variants, self.returns)

    @property
    def score_mean(self) -> float:
        """Mean normalised score."""
        return float(self.scores.mean())

    @property
    def score_iqm(self) -> float:
        """Interquartile mean of the normalised scores."""
        return interquartile_mean(self.scores)

    @property
    def score_interval(self) -> tuple[float, float]:
        """95 % bootstrap interval of the interquartile mean of the normalised scores."""
        return bootstrap_interval(self.scores)


def evaluate(
    env: Variant | str | gym.Env[Any, Any],
    policy: Any,
    *,
    episodes: int = 100,
    seed: int = 0,
    on_episode: Callable[[], None] | None = None,
) -> Evaluation:
    """Run seeded episodes of a policy and return the result of each.

    Equal seeds give equal initial states, whatever the policy. Actions go to the environment as they are.

    Args:
        env: a variant, its id, the id of any registered environment, or an environment, which is not closed.
            For a variant or an id, up to 16 episodes run side by side, and a policy that takes batches
            computes their actions together. An environment runs one episode after the other.
        policy: a function of the observation, a torch module, a model of Stable-Baselines3 or d3rlpy, or a
            policy of this package: see :func:`~imujoco_minari.policies.adapters.batch_act`.
        episodes: number of episodes.
        seed: base seed of the episodes.
        on_episode: called after each episode.

    Raises:
        VariantError: when ``env`` is not a variant's id.
        ArgumentError: when another argument is not valid.
        PolicyError: when the policy fails or returns no actions of the environment. A wrong policy fails
            before the first step.

    Example:
        >>> evaluation = evaluate("hopper-base", load_policy("hopper-base"), episodes=10)  # doctest: +SKIP
        >>> evaluation.returns.shape, evaluation.score_mean  # doctest: +SKIP
        ((10,), 1.0)
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
    return Evaluation(returns, lengths, tuple(variants), seed, told)


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
