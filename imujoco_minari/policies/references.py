"""Reference scores: the returns of a random policy and of the expert on a variant, as metadata state them."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from imujoco_minari.policies import expert_record, random_policy
from imujoco_minari.policies.evaluation import Evaluation, evaluate
from imujoco_minari.variants import Variant
from imujoco_minari.variants.robots import follows_page

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


@follows_page
@lru_cache(maxsize=256)
def random_evaluation(variant: Variant) -> Evaluation:
    """Evaluate the random policy for 100 episodes of a variant."""
    return evaluate(variant, random_policy(variant.robot), episodes=EPISODES)
