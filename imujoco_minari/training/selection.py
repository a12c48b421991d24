"""The selection of a run's best actor: evaluations in stages, and the score that decides."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from imujoco_minari.policies import Actor, Array
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.rungs import share_of
from imujoco_minari.policies.universal import UniversalPolicy
from imujoco_minari.training.agents import ALGORITHM, actor_of
from imujoco_minari.training.task import Task
from imujoco_minari.variants.context import parameters

# Base seeds of the evaluations that rank and choose. They differ from the default seed of datasets, 0.
RANKING_SEED, CHOOSING_SEED = 1_000_001, 1_000_002
# The next stage follows unless the mean is below the best score by more than this share of it.
_MARGIN = 0.02
# A variant counts at most this share of what is wanted, so that easy variants do not hide weak ones.
_MOST = 1.1


class Look(NamedTuple):
    """An evaluation of an actor.

    Attributes:
        summary: for JSON: of one variant's returns, or of the shares in all variants.
        mean: mean return, or mean share.
        score: mean of mean and lowest return, or the mean of these as shares.
    """

    summary: dict[str, Any]
    mean: float
    score: float


def score(evaluation: Mapping[str, Any]) -> float:
    """Return the mean of mean and lowest return. It is low for a policy that falls now and then."""
    return float(evaluation["return_mean"] + evaluation["return_min"]) / 2


def look(task: Task, arrays: Mapping[str, Array], episodes: int, seed: int) -> Look:
    """Evaluate an actor, as it is stored, for some episodes in each variant of a task."""
    robot = task.variant.robot
    if task.over is None:
        found = evaluate(task.variant, actor_of(arrays, robot), episodes=episodes, seed=seed).asdict()
        return Look(found, found["return_mean"], score(found))
    policy = universal_of(arrays, robot)
    shares, scores = [], []
    for variant in task.over.listed:
        found = evaluate(variant, policy.fold(variant), episodes=episodes, seed=seed).asdict()
        shares.append(share_of(found["return_mean"], task.over.expert))
        scores.append(share_of(score(found), task.over.expert))
    summary = {
        "median": float(np.median(shares)),
        "mean": float(np.mean(shares)),
        "min": min(shares),
        "weakest": [str(task.over.listed[i]) for i in np.argsort(shares)[:3]],
    }
    mean, lower = (float(np.minimum(each, _MOST).mean()) for each in (shares, scores))
    return Look(summary, mean, lower)


def better(task: Task, arrays: Mapping[str, Array], ranked: Look, best: float) -> Look | None:
    """Return an actor's evaluation over the deciding episodes if its score is above ``best``, else None.

    ``ranked`` is its evaluation over the ranking episodes. Scores may be negative.
    """
    if ranked.mean < best - _MARGIN * abs(best):
        return None
    found = ranked
    for episodes in (task.settings.choosing_episodes, task.settings.deciding_episodes):
        found = look(task, arrays, episodes, CHOOSING_SEED)
        if found.score <= best:
            return None
    return found


def universal_of(arrays: Mapping[str, Array], robot: str) -> UniversalPolicy:
    """Return a universal policy with stored weights, which is told any context as it is."""
    weights = {name: array.astype(np.float32) for name, array in arrays.items()}
    far = np.full(len(parameters(robot)), np.inf)
    return UniversalPolicy(robot, Actor(weights, ALGORITHM), -far, far, {})
