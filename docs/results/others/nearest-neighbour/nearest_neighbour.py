"""The nearest neighbour of docs/benchmark.md, in few-shot imitation."""

import numpy as np


class NearestNeighbour:
    """Copy the action of the nearest demonstrated observation."""

    def __init__(self, seed):
        self.seed = seed
        self.distance = "L1, observations divided by their standard deviation"

    def fit(self, train):
        """Measure the deviations of the training variants' observations."""
        self._scale = train.observations.std(axis=0) + 1e-6

    def adapt(self, demonstrations):
        """Return the policy."""
        seen, actions = demonstrations.observations / self._scale, demonstrations.actions
        return lambda observation: actions[np.abs(seen - observation / self._scale).sum(axis=1).argmin()]
