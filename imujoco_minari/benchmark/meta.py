"""Methods that learn to adapt on the training variants: first-order MAML, and a set encoder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from imujoco_minari.benchmark.cloning import Fitted, Pretrained
from imujoco_minari.benchmark.networks import (
    HIDDEN,
    Loss,
    Network,
    Problem,
    bind,
    draw_variants,
    forward,
    gradient_step,
    new_network,
    new_policy,
    padded,
    squared_error,
    to_actor,
)
from imujoco_minari.loading import Arrays
from imujoco_minari.policies import Actor, Array
from imujoco_minari.training.agents import import_jax

_ENCODER_HIDDEN = (128, 128)


@dataclass
class Maml(Pretrained):
    """First-order MAML: initial weights from which a few steps go far.

    Each step of ``fit`` draws some training variants. A copy of the weights takes a few gradient steps on
    rows of one variant; the gradient of the copy's loss on other rows of that variant moves the initial
    weights. Maml adapts as the other methods do: by Adam on the demonstrations.

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

    def _problem(self, inputs: Array, train: Arrays) -> Problem:
        rate = np.float32(self.inner_rate)
        data = (padded(inputs), padded(train.actions), *variant_blocks(train), rate)
        loss = meta_loss(self.tasks, self.rows, self.inner_steps)
        return loss, new_policy(inputs, train.actions, self.seed), data


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


@dataclass
class SetEncoder(Fitted):
    """A policy conditioned on the demonstrations: a set encoder turns them into a context vector.

    The encoder maps each step (observation, action) to a vector; the mean over the steps is the context.
    The policy takes observation and context. Both are trained together on the training variants. Adapting
    needs no gradient step: it computes the context.

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

    def _problem(self, inputs: Array, train: Arrays) -> Problem:
        observation, action = inputs.shape[1], train.actions.shape[1]
        networks = (
            new_network((observation + action, *_ENCODER_HIDDEN, self.context), self.seed),
            new_network((observation + self.context, *HIDDEN, action), self.seed + 1),
        )
        data = (padded(inputs), padded(train.actions), *variant_blocks(train))
        return conditioned_loss(self.tasks, self.rows), networks, data

    def adapt(self, demonstrations: Arrays) -> Mapping[int, Actor]:
        """Return the policy with the context of the demonstrations."""
        encoder, policy = self._network
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


def variant_blocks(train: Arrays) -> tuple[Any, Any]:
    """Return the first row and the number of rows of each variant, whose rows must lie together."""
    _, starts, counts = np.unique(train.variant_index, return_index=True, return_counts=True)
    return starts.astype(np.int32), counts.astype(np.int32)
