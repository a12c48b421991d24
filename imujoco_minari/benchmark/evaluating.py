"""How the benchmark evaluates a policy: always the same episodes of a variant, and an error of actions."""

from __future__ import annotations

from typing import Any

import numpy as np

from imujoco_minari.benchmark import protocol
from imujoco_minari.envs.registration import make
from imujoco_minari.loading import Arrays
from imujoco_minari.policies.rollouts import episode_seed, roll_out
from imujoco_minari.variants import Variant


def episode_returns(policy: Any, variant: Variant) -> list[float]:
    """Return the return of each evaluation episode of a policy on a variant."""
    env = make(variant)
    try:
        seeds = (episode_seed(protocol.EVALUATION_SEED, i) for i in range(protocol.EVALUATION_EPISODES))
        return [round(roll_out(env, policy, seed)[0], 2) for seed in seeds]
    finally:
        env.close()


def relative_error(policy: Any, query: Arrays) -> float:
    """Return the norm of the errors of a policy's actions, divided by the norm of the data's actions."""
    rng = np.random.default_rng(0)
    actions = np.array([policy.act(row, rng) for row in query.observations])
    return round(float(np.linalg.norm(actions - query.actions) / np.linalg.norm(query.actions)), 4)
