"""Reference scores: what a random policy and the shipped expert make on a variant.

Minari normalises a return between the two (``minari.get_normalized_score``).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from imujoco_minari.envs.registration import make
from imujoco_minari.policies import RandomPolicy, expert_record
from imujoco_minari.policies.rollouts import Evaluation, evaluate
from imujoco_minari.variants import Variant, specification

EPISODES = 100


def reference_scores(variant: Variant) -> dict[str, Any]:
    """Return ``ref_min_score`` and, where an expert is shipped, ``ref_max_score`` of a variant.

    With them come the evaluations behind them. A variant without a record has its random policy
    measured here, which takes seconds.
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
    """Roll the random policy out for 100 episodes of ``variant`` and return what it scores."""
    env = make(variant)
    try:
        return evaluate(env, RandomPolicy(specification(variant.robot).action_size), episodes=EPISODES)
    finally:
        env.close()
