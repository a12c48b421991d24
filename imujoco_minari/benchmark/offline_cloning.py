"""Behaviour cloning of a dataset, of all its episodes or of those with the highest returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imujoco_minari.benchmark.cloning import robust_statistics
from imujoco_minari.benchmark.networks import Initial, clone, new_policy, to_actor
from imujoco_minari.loading import Arrays
from imujoco_minari.policies import Actor


@dataclass(frozen=True)
class Cloning:
    """Behaviour cloning.

    Attributes:
        seed: seed of the weights and of the batches.
        checkpoints: numbers of gradient steps after which the policy is kept.
        best: share of the steps to clone, of the episodes with the highest returns.
        rate: learning rate.
        batch: rows of a batch.
        initial: distribution of the initial weights.
    """

    seed: int
    checkpoints: tuple[int, ...]
    best: float = 1.0
    rate: float = 3e-4
    batch: int = 128
    initial: Initial = "pytorch"

    def train(self, data: Arrays) -> dict[int, Actor]:
        """Return the policy at each checkpoint."""
        order = np.argsort(-data.returns, kind="stable")
        steps = np.cumsum(data.episode_lengths[order])
        # At least one episode.
        kept = data.select(np.sort(order[: 1 + np.searchsorted(steps, self.best * len(data))]))
        statistics = robust_statistics(kept.observations)
        inputs = statistics.normalize(kept.observations)
        network = new_policy(inputs, kept.actions, self.seed, self.initial)
        networks = clone(
            network, inputs, kept.actions, self.checkpoints, rate=self.rate, seed=self.seed, batch=self.batch
        )
        return {
            updates: to_actor(network, statistics, "behaviour cloning")
            for updates, network in networks.items()
        }
