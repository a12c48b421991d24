"""Searches the context with which a universal policy acts best in one variant.

The variant's own context is not always the best: told a lighter leg, a policy may run faster. So the contexts
of the listed variants are tried, and CMA-ES searches from the best of them. Yu et al. (2019) call this
strategy optimisation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from imujoco_minari.envs.registration import max_episode_steps
from imujoco_minari.policies import Array
from imujoco_minari.policies.universal import UniversalPolicy
from imujoco_minari.training.distilling import TEACHER_SEED
from imujoco_minari.training.lanes import Lanes
from imujoco_minari.variants import Variant

SEARCHED = "a searched context"
# Episodes of a generation, each with a context of its own, and the deviation of the first contexts.
_POPULATION, _SIGMA = 40, 0.06
# Deviation of the noise on actions. A policy that is found without noise runs faster but sometimes falls.
_NOISE = 0.05
# Generations between two of the contexts that are returned.
_EVERY = 10
# Steps of an episode of a robot without a time limit.
_STEPS = 1000


def best_told(universal: UniversalPolicy, variant: Variant, others: Sequence[Variant]) -> list[Variant]:
    """Return the three other variants whose contexts make a universal policy best in a variant, best first.

    One episode decides.
    """
    contexts = np.array([universal.context(other) for other in others])
    order = np.argsort(-_returns(universal, variant, contexts, TEACHER_SEED))
    return [others[index] for index in order[:3]]


def search_contexts(
    universal: UniversalPolicy, variant: Variant, start: Array, generations: int
) -> list[Array]:
    """Search the contexts of a universal policy for those with the highest returns in a variant.

    The search begins at the context ``start``. A generation has 40 episodes. The centre of every tenth
    generation is returned, a context that may lie outside the ranges of training.
    """
    from cmaes import CMA

    search = CMA(mean=start.astype(float), sigma=_SIGMA, population_size=_POPULATION, seed=TEACHER_SEED)
    found = []
    for generation in range(1, generations + 1):
        contexts = np.array([search.ask() for _ in range(_POPULATION)])
        returns = _returns(universal, variant, contexts, TEACHER_SEED + generation, _NOISE)
        search.tell([(context, -value) for context, value in zip(contexts, returns.tolist(), strict=True)])
        if generation % _EVERY == 0:
            found.append(np.array(search.mean))
    return found


def _returns(
    universal: UniversalPolicy, variant: Variant, contexts: Array, seed: int, noise: float = 0.0
) -> Array:
    """Return the return of one episode with each of the contexts; shape (contexts,)."""
    rng, count = np.random.default_rng(seed), len(contexts)
    lanes = Lanes(variant.robot, count, lambda lane, episode: variant, seed, told=False)
    lanes.restart()
    returns, alive = np.zeros(count), np.ones(count, bool)
    # On busy cores, BLAS's threads wait for each other.
    with threadpool_limits(limits=1, user_api="blas"):
        for _ in range(max_episode_steps(variant.robot) or _STEPS):
            inputs = np.concatenate([lanes.observations, contexts], axis=1, dtype=np.float32)
            actions = np.tanh(universal.actor.distribution(inputs)[0])
            if noise:
                actions = np.clip(actions + noise * rng.standard_normal(actions.shape), -1.0, 1.0)
            stepped = lanes.step(actions)
            returns += alive * stepped.rewards
            alive &= ~stepped.terminated
    lanes.close()
    return returns
