"""Reference scores: the returns of a random policy and of the expert on a variant.

The normalised score maps the first to 0 and the second to 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from imujoco_minari.errors import ArgumentError, PolicyNotFoundError, clipped
from imujoco_minari.policies import Array, expert_record, random_policy
from imujoco_minari.policies.evaluation import Evaluation, evaluate
from imujoco_minari.variants import Variant

EPISODES = 100


def reference_scores(variant: Variant) -> dict[str, Any]:
    """Return the reference scores of a variant as metadata, with the evaluations that they come from.

    ``ref_max_score`` is missing if the variant has no expert. If it has no record, the random policy is
    evaluated now, which takes seconds.
    """
    record = expert_record(variant)
    random = record.get("random") or random_evaluation(variant).asdict()
    scores: dict[str, Any] = {
        "ref_min_score": random["return_mean"],
        "num_episodes_average_score": random["episodes"],
        "ref_min_evaluation": random,
    }
    if "evaluation" in record:
        expert = record["evaluation"]
        scores |= {"ref_max_score": expert["return_mean"], "ref_max_evaluation": expert}
    return scores


@lru_cache(maxsize=256)
def random_evaluation(variant: Variant) -> Evaluation:
    """Evaluate the random policy for 100 episodes of a variant."""
    return evaluate(variant, random_policy(variant.robot), episodes=EPISODES)


def normalized_score(variant: Variant | str | Sequence[Variant | str], returns: ArrayLike) -> Array:
    """Return normalised scores: 0 for the return of a variant's random policy, 1 for that of its expert.

    The references come from the records of the policies, so no dataset is needed.

    Args:
        variant: the variant or its id, or a sequence with one for each return, as a collection needs.
        returns: undiscounted returns, of any shape; of shape (n,) for a sequence of n variants.

    Returns:
        The scores, float64, of the shape of ``returns``.

    Raises:
        VariantError: when an id is not of a variant.
        PolicyNotFoundError: when a variant has no expert.
        ArgumentError: when ``returns`` are not numbers, or not as many as the variants.

    Example:
        >>> normalized_score("hopper-base", [18.0, 3500.0])  # doctest: +SKIP
        array([0.001, 0.977])
    """
    values = np.asarray(returns)
    if values.dtype.kind not in "fiu":
        raise ArgumentError(f"returns must be numbers, not {clipped(repr(returns))}")
    if isinstance(variant, Variant | str):
        low, high = _references(Variant.parse(variant))
        return np.asarray((values - low) / (high - low))
    if not isinstance(variant, Sequence) or values.shape != (len(variant),):
        raise ArgumentError(
            "give a variant, or a sequence with one variant for each return; "
            f"the returns have the shape {values.shape}"
        )
    known = {each: _references(Variant.parse(each)) for each in dict.fromkeys(variant)}
    lows, highs = np.array([known[each] for each in variant]).reshape(-1, 2).T
    return np.asarray((values - lows) / (highs - lows))


def _references(variant: Variant) -> tuple[float, float]:
    """Return the returns that score 0 and 1."""
    if "evaluation" not in expert_record(variant):
        raise PolicyNotFoundError(
            f"{variant} has no expert, so no return scores 1: train one with `imujoco train {variant}`"
        )
    scores = reference_scores(variant)
    return float(scores["ref_min_score"]), float(scores["ref_max_score"])
