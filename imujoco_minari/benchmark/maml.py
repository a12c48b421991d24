"""Model-agnostic meta-learning, first order: initial weights from which a few steps go far.

Each step draws some training variants. A copy of the weights takes a few gradient steps on rows of one
variant; the gradient of the copy's loss on other rows of that variant moves the initial weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from imujoco_minari.benchmark.cloning import Pretrained, robust_statistics
from imujoco_minari.benchmark.networks import (
    Loss,
    Network,
    descend,
    draw_variants,
    gradient_step,
    new_policy,
    padded,
    squared_error,
)
from imujoco_minari.loading import Arrays
from imujoco_minari.training.agents import import_jax


@dataclass
class Maml(Pretrained):
    """First-order MAML, adapted as the other methods are: by Adam on the demonstrations.

    Attributes:
        inner_rate: learning rate of the copies' steps, which are plain gradient descent.
        inner_steps: number of the copies' steps.
        tasks: training variants in each step.
        rows: rows of a variant for the copy's steps, and as many others for its loss.
    """

    fit_rate: float = 5e-4
    fit_steps: int = 5_000
    inner_rate: float = 0.1
    inner_steps: int = 3
    tasks: int = 8
    rows: int = 64

    def fit(self, train: Arrays) -> None:
        """Find initial weights on the training variants."""
        self._statistics = robust_statistics(train.observations)
        inputs = self._statistics.normalize(train.observations)
        starts, counts = variant_blocks(train)
        network = new_policy(inputs, train.actions, self.seed)
        loss = meta_loss(self.tasks, self.rows, self.inner_steps)
        data = (padded(inputs), padded(train.actions), starts, counts, np.float32(self.inner_rate))
        steps = self.fit_steps
        self._network = descend(loss, network, data, [steps], rate=self.fit_rate, seed=self.seed)[steps]


@cache
def meta_loss(tasks: int, rows: int, inner_steps: int) -> Loss:
    """Return the loss of first-order MAML; its data are (inputs, actions, starts, counts, inner rate)."""
    jax = import_jax()

    def loss(network: Network, key: Any, data: tuple[Any, ...]) -> Any:
        inputs, actions, starts, counts, inner_rate = data
        _, drawn = draw_variants(key, starts, counts, tasks, 2 * rows)

        def after_adapting(support: Any, query: Any) -> Any:
            adapted = network
            for _ in range(inner_steps):
                adapted = gradient_step(
                    adapted, lambda own: squared_error(own, inputs[support], actions[support]), inner_rate
                )
            return squared_error(adapted, inputs[query], actions[query])

        return jax.vmap(after_adapting)(drawn[:, :rows], drawn[:, rows:]).mean()

    return loss


def variant_blocks(train: Arrays) -> tuple[Any, Any]:
    """Return the first row and the number of rows of each variant, whose rows must lie together."""
    _, starts, counts = np.unique(train.variant_index, return_index=True, return_counts=True)
    return starts.astype(np.int32), counts.astype(np.int32)
