"""Reference scores: the returns of the random policy and of the expert of a variant, which score 0 and 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from imujoco_minari.errors import ArgumentError, PolicyNotFoundError, clipped
from imujoco_minari.policies.actors import Actor, Policy
from imujoco_minari.policies.doors import Array
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.experts import expert_actor, expert_record, is_folded, keep_measured
from imujoco_minari.policies.rungs import (
    LADDER_EPISODES,
    LADDER_SEED,
    Rung,
    has_medium,
    mean_return,
    read_rung,
    rungs_of_robot,
    share_of,
)
from imujoco_minari.policies.uniform import random_policy
from imujoco_minari.variants import Variant
from imujoco_minari.variants.robots import follows_page

EPISODES = 100
# Base seed of the episodes that confirm an expert. They chose nothing, and no dataset begins with it.
CONFIRMING_SEED = 1_000_003
# A folded expert below this share of its base's return is named before its data are published.
WEAK_SHARE = 0.5


def measured_record(variant: Variant) -> Mapping[str, Any]:
    """Return the record of a variant's expert with its evaluations; empty when it has no expert.

    A folded expert is evaluated at the first need, over 100 episodes, which takes seconds. The result is
    kept beside the user's policies.
    """
    record = expert_record(variant)
    if not record or "evaluation" in record:
        return record
    measured = evaluations(variant, expert_actor(variant))
    keep_measured(variant, measured)
    return dict(record) | measured


def ladder(variant: Variant) -> Sequence[Rung]:
    """Return the rungs of a variant's ladder, the lowest return first.

    A record may have a ladder. If it has no rung for ``medium``, all rungs of the robot are added: they are
    evaluated on the variant at the first need, and the result is kept beside the user's policies.

    Raises:
        PolicyNotFoundError: if the variant has no expert, or its robot has no rungs.
    """
    record = measured_record(variant)
    rungs = list(record.get("ladder", []))
    known = [(rung.get("run"), rung["steps"]) for rung in rungs]
    missing = [rung for rung in rungs_of_robot(variant.base) if (rung.get("run"), rung["steps"]) not in known]
    if record and missing and not has_medium(record):
        for rung in missing:
            actor = read_rung(variant, rung)
            rungs.append(rung | {"evaluation": _evaluation(variant, actor, LADDER_SEED, LADDER_EPISODES)})
        evaluated = {name: record[name] for name in ("weights_sha256", "evaluation", "random")}
        keep_measured(variant, evaluated | {"ladder": rungs})
    if not record:
        # This names the missing expert and raises.
        expert_actor(variant)
    if not rungs:
        raise PolicyNotFoundError(
            f"no ladder of policies exists for {variant}: `imujoco train {variant.base}` makes one"
        )
    return sorted(rungs, key=mean_return)


def weakness_of(variant: Variant) -> str:
    """Return a sentence that names the weakness of a variant's folded expert; empty if it is not weak.

    It is weak if it fell in its 100 episodes, or if it has less than half of the base expert's return.
    """
    record, base = measured_record(variant), measured_record(variant.base)
    if not is_folded(record) or "evaluation" not in base:
        return ""
    evaluation = record["evaluation"]
    share = share_of(evaluation["return_mean"], base)
    falls = evaluation["length_mean"] < base["evaluation"]["length_mean"]
    weak = [f"has {share:.2f} of the base expert's return"] if share < WEAK_SHARE else []
    weak += ["falls in some episodes"] if falls else []
    if not weak:
        return ""
    return f"the expert of {variant} {' and '.join(weak)}: `imujoco train {variant}` may make a better one"


def evaluations(variant: Variant, expert: Actor) -> dict[str, Any]:
    """Return the evaluations of an expert and of the random policy on a variant, as records hold them."""
    return {
        "weights_sha256": expert.sha256,
        "evaluation": _evaluation(variant, expert, CONFIRMING_SEED),
        "random": random_evaluation(variant),
    }


def reference_scores(variant: Variant) -> dict[str, Any]:
    """Return the reference scores of a variant as metadata, with the evaluations that they come from.

    ``ref_max_score`` is missing if the variant has no expert. Evaluations that no record has are made now,
    which takes seconds.
    """
    record = measured_record(variant)
    random = record.get("random") or random_evaluation(variant)
    scores: dict[str, Any] = {
        "ref_min_score": random["return_mean"],
        "num_episodes_average_score": random["episodes"],
        "ref_min_evaluation": random,
    }
    if "evaluation" in record:
        expert = record["evaluation"]
        scores |= {"ref_max_score": expert["return_mean"], "ref_max_evaluation": expert}
    return scores


def normalized_score(variant: Variant | str | Sequence[Variant | str] | Array, returns: ArrayLike) -> Array:
    """Return normalised scores: 0 for the return of a variant's random policy, 1 for that of its expert.

    The references come from the records of the policies, so no dataset is needed. A folded expert is
    evaluated at the first need, which takes seconds.

    Args:
        variant: the variant or its id, or a sequence or array with one for each return, as a collection
            needs.
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
    if isinstance(variant, np.ndarray):
        variant = variant.tolist()
    if isinstance(variant, Variant | str):
        low, high = _references(Variant.parse(variant))
        return np.asarray((values - low) / (high - low))
    if not isinstance(variant, Sequence) or values.shape != (len(variant),):
        raise ArgumentError(
            "give a variant, or a sequence with one variant for each return; "
            f"the returns have the shape {values.shape}"
        )
    variants = [Variant.parse(each) for each in variant]
    known = {each: _references(each) for each in dict.fromkeys(variants)}
    lows, highs = np.array([known[each] for each in variants]).reshape(-1, 2).T
    return np.asarray((values - lows) / (highs - lows))


def _references(variant: Variant) -> tuple[float, float]:
    """Return the returns that score 0 and 1."""
    record = measured_record(variant)
    if "evaluation" not in record:
        raise PolicyNotFoundError(
            f"{variant} has no expert, so no return scores 1: train one with `imujoco train {variant}`"
        )
    return float(record["random"]["return_mean"]), float(record["evaluation"]["return_mean"])


@follows_page
@lru_cache(maxsize=256)
def random_evaluation(variant: Variant) -> dict[str, Any]:
    """Evaluate the random policy for 100 episodes of a variant and return a summary of them."""
    return _evaluation(variant, random_policy(variant.robot), 0)


def _evaluation(variant: Variant, policy: Policy, seed: int, episodes: int = EPISODES) -> dict[str, Any]:
    return evaluate(variant, policy, episodes=episodes, seed=seed).asdict()
