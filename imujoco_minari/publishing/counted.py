"""Datasets with a number of transitions, as off-dynamics learning needs them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imujoco_minari.errors import ArgumentError
from imujoco_minari.policies import load_policy
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.publishing.outcome import Published
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.storage import transactions
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.storage.minari_root import dataset_folder
from imujoco_minari.variants import EXPERT, Variant


def publish_transitions(
    variant: Variant | str,
    transitions: int = 5_000,
    *,
    tier: str = EXPERT,
    seed: int = 0,
    policy: Path | str | None = None,
    jobs: int = 1,
    force: bool = False,
) -> Published:
    """Publish a variant's dataset with as many episodes as the given number of transitions takes.

    The first episodes of a dataset do not depend on how many follow. So a published dataset of the same
    policy and seed that has enough transitions is left alone.

    Args:
        variant: the variant, or its id.
        transitions: number of transitions. The dataset has at least as many, because its episodes are whole.
        tier: a tier that one policy makes, or any name if ``policy`` is given.
        seed: base seed of all random numbers.
        policy: a policy file to use instead of the shipped policy.
        jobs: number of processes.
        force: replace a published dataset.

    Raises:
        ArgumentError: if ``transitions`` is less than 1.
        ImujocoError: what :func:`~imujoco_minari.publish` raises.
    """
    if transitions < 1:
        raise ArgumentError(f"a dataset has at least one transition, not {transitions}")
    variant, episodes = Variant.parse(variant), 0
    dataset_id = variant.dataset_id(tier)
    if transactions.taken(dataset_id) and not force:
        stated = read_metadata(dataset_folder(dataset_id) / "data")
        if stated.get("total_steps", 0) >= transitions:
            episodes = stated["total_episodes"]
    return publish(
        variant,
        tier=tier,
        episodes=episodes or _episodes(variant, transitions, tier, seed, policy),
        seed=seed,
        policy=policy,
        jobs=jobs,
        force=force,
    )


def _episodes(variant: Variant, transitions: int, tier: str, seed: int, policy: Path | str | None) -> int:
    """Return how many episodes have this many transitions. They are run to count them."""
    acting, count = load_policy(variant, tier=tier, path=policy), 1
    while True:
        ends = np.cumsum(evaluate(variant, acting, episodes=count, seed=seed).lengths)
        if ends[-1] >= transitions:
            return int(np.searchsorted(ends, transitions)) + 1
        # A quarter more than the mean length suggests, so that a second count is seldom needed.
        count = max(count + 1, round(1.25 * count * transitions / ends[-1]))
