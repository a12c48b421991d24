"""Evaluation of a policy: the return, the length and the normalised score of each of its episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym

from imujoco_minari.errors import VariantError
from imujoco_minari.policies.aggregates import bootstrap_interval, interquartile_mean
from imujoco_minari.policies.doors import Array
from imujoco_minari.policies.measuring import Episodes, measure
from imujoco_minari.policies.references import normalized_score
from imujoco_minari.variants import Variant


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation(Episodes):
    """The results of E episodes of a policy, with statistics and normalised scores.

    Attributes:
        returns: (E,) float64; the undiscounted returns.
        lengths: (E,) int64; the numbers of steps.
        variants: the id of each episode's variant; empty for an environment that is no variant.
        seed: base seed of the episodes.
        deterministic: whether the policy acted deterministically; None where the policy does not say.
    """

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

    @cached_property
    def scores(self) -> Array:
        """(E,) float64; the normalised scores: 0 for the random policy of the variant, 1 for its expert.

        Raises:
            VariantError: when the environment is no variant.
            PolicyNotFoundError: when a variant has no expert.
        """
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
    return Evaluation(**vars(measure(env, policy, episodes, seed, on_episode)))
