"""How the benchmark evaluates a policy: always the same episodes of a variant, and an error of actions."""

from __future__ import annotations

from typing import Any

import numpy as np

from imujoco_minari.benchmark.protocol import EVALUATION_SEED
from imujoco_minari.loading import Arrays
from imujoco_minari.policies import LANES
from imujoco_minari.policies.adapters import batch_act
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.variants import Variant


def episode_returns(policy: Any, variant: Variant, episodes: int) -> list[float]:
    """Return the return of each of the first evaluation episodes of a policy on a variant."""
    found = evaluate(variant, policy, episodes=episodes, seed=EVALUATION_SEED)
    return [round(float(each), 2) for each in found.returns]


def relative_error(policy: Any, query: Arrays) -> float:
    """Return the norm of the errors of a policy's actions, divided by the norm of the data's actions."""
    if hasattr(policy, "actions_of"):
        # A policy with a memory needs the steps in order.
        actions = policy.actions_of(query)
    else:
        act, rows = batch_act(policy), query.observations
        rngs = [np.random.default_rng(i) for i in range(LANES)]
        blocks = [rows[start : start + LANES] for start in range(0, len(rows), LANES)]
        actions = np.concatenate([act(block, rngs[: len(block)]) for block in blocks])
    return round(float(np.linalg.norm(actions - query.actions) / np.linalg.norm(query.actions)), 4)
