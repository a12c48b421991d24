"""A policy conditioned on the demonstrations: a set encoder turns them into a context vector.

The encoder maps each step (observation, action) to a vector; the mean over the steps is the context. The
policy takes observation and context. Both are trained together on the training variants. Adapting needs no
gradient step: it computes the context.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from imujoco_minari.benchmark.cloning import robust_statistics
from imujoco_minari.benchmark.maml import variant_blocks
from imujoco_minari.benchmark.networks import (
    HIDDEN,
    Loss,
    bind,
    descend,
    draw_variants,
    forward,
    new_network,
    padded,
    squared_error,
    to_actor,
)
from imujoco_minari.loading import Arrays
from imujoco_minari.policies import Actor
from imujoco_minari.training.agents import import_jax

_ENCODER_HIDDEN = (128, 128)


@dataclass
class SetEncoder:
    """A policy conditioned on the demonstrations by a set encoder.

    Attributes:
        seed: seed of the weights and of the batches.
        context: length of the context vector.
        fit_rate: learning rate.
        fit_steps: steps on the training variants.
        tasks: training variants in each step.
        rows: rows of a variant for its context, and a quarter as many others to imitate.
    """

    seed: int = 0
    context: int = 16
    fit_rate: float = 1e-3
    fit_steps: int = 20_000
    tasks: int = 8
    rows: int = 64
    _networks: Any = field(default=None, init=False, repr=False)
    _statistics: Any = field(default=None, init=False, repr=False)

    def fit(self, train: Arrays) -> None:
        """Train encoder and policy on the training variants."""
        self._statistics = robust_statistics(train.observations)
        inputs = self._statistics.normalize(train.observations)
        observation, action = inputs.shape[1], train.actions.shape[1]
        networks = (
            new_network((observation + action, *_ENCODER_HIDDEN, self.context), self.seed),
            new_network((observation + self.context, *HIDDEN, action), self.seed + 1),
        )
        data = (padded(inputs), padded(train.actions), *variant_blocks(train))
        loss, steps = conditioned_loss(self.tasks, self.rows), self.fit_steps
        self._networks = descend(loss, networks, data, [steps], rate=self.fit_rate, seed=self.seed)[steps]

    def adapt(self, demonstrations: Arrays) -> Mapping[int, Actor]:
        """Return the policy with the context of the demonstrations."""
        encoder, policy = self._networks
        inputs = self._statistics.normalize(demonstrations.observations)
        steps = np.concatenate((inputs, demonstrations.actions), axis=1).astype(np.float32)
        context = forward(encoder, steps).mean(axis=0)
        return {0: to_actor(bind(policy, context), self._statistics, "set encoder")}


@cache
def conditioned_loss(tasks: int, rows: int) -> Loss:
    """Return the loss of the conditioned policy; its data are (inputs, actions, starts, counts)."""
    jax = import_jax()
    jnp = jax.numpy

    def loss(networks: Any, key: Any, data: tuple[Any, ...]) -> Any:
        encoder, policy = networks
        inputs, actions, starts, counts = data
        imitated = rows // 4
        _, drawn = draw_variants(key, starts, counts, tasks, rows + imitated)
        shown, asked = drawn[:, :rows], drawn[:, rows:]
        steps = jnp.concatenate((inputs[shown], actions[shown]), axis=-1)
        context = forward(encoder, steps).mean(axis=1, keepdims=True)
        context = jnp.broadcast_to(context, (tasks, imitated, context.shape[-1]))
        return squared_error(policy, jnp.concatenate((inputs[asked], context), axis=-1), actions[asked])

    return loss
