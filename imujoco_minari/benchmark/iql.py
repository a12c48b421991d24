"""Implicit Q-learning (Kostrikov and others, 2021): it learns from the values of the data's own actions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from imujoco_minari.benchmark.cloning import robust_statistics
from imujoco_minari.benchmark.critics import (
    critic_error,
    draw_transitions,
    follow,
    new_critics,
    run_updates,
    transition_data,
    values,
)
from imujoco_minari.benchmark.networks import (
    HIDDEN,
    Initial,
    Update,
    adam,
    forward,
    minimise,
    new_network,
    new_policy,
    to_actor,
)
from imujoco_minari.loading import Arrays
from imujoco_minari.policies import Actor
from imujoco_minari.training.agents import import_jax


@dataclass(frozen=True)
class Iql:
    """Implicit Q-learning with the paper's hyperparameters for locomotion, but half its batch.

    Attributes:
        seed: seed of the weights and of the batches.
        checkpoints: numbers of updates after which the policy is kept.
        rate: learning rate; that of the actor falls by a cosine, to 0 at the last checkpoint.
        batch: rows of a batch.
        discount: discount factor.
        follow_share: share by which the target critics follow at each update.
        expectile: expectile of the critics' values that the state value learns.
        sharpness: factor of the advantage in the exponent of an action's weight.
        weight_limit: largest weight of an action.
        initial: distribution of the initial weights.
    """

    seed: int
    checkpoints: tuple[int, ...]
    rate: float = 3e-4
    batch: int = 128
    discount: float = 0.99
    follow_share: float = 0.005
    expectile: float = 0.7
    sharpness: float = 3.0
    weight_limit: float = 100.0
    initial: Initial = "pytorch"

    def train(self, data: Arrays) -> dict[int, Actor]:
        """Return the policy at each checkpoint."""
        statistics = robust_statistics(data.observations)
        observation, action = data.observations.shape[1], data.actions.shape[1]
        policy = new_policy(data.observations, data.actions, self.seed, self.initial)
        actor = (policy, np.zeros(action, np.float32))
        critics = new_critics(observation, action, self.seed, self.initial)
        value = new_network((observation, *HIDDEN, 1), self.seed + 3000, self.initial)
        moments = tuple(adam().init(part) for part in (actor, critics, value))
        # As in the paper: the returns of the episodes span 1000.
        spread = float(np.ptp(data.returns))
        scaled = transition_data(data, statistics, 1000.0 / spread if spread else 1.0)
        state = (np.int32(0), np.int32(max(self.checkpoints)), actor, critics, critics, value, moments)
        states = run_updates(self, _update, state, scaled)
        return {updates: to_actor(state[2][0], statistics, "IQL") for updates, state in states.items()}


@cache
def _update(settings: Iql) -> Update:
    jax = import_jax()
    jnp = jax.numpy

    def update(state: Any, key: Any, data: Any) -> Any:
        number, updates, actor, critics, target_critics, value, moments = state
        actor_moments, critic_moments, value_moments = moments
        observations, actions, rewards, following, ended = draw_transitions(key, data, settings.batch)
        least = jnp.minimum(*values(target_critics, observations, actions))

        def value_loss(value: Any) -> Any:
            advantage = least - forward(value, observations)[:, 0]
            weight = jnp.where(advantage > 0, settings.expectile, 1.0 - settings.expectile)
            return (weight * advantage**2).mean()

        next_values = forward(value, following)[:, 0]
        advantage = least - forward(value, observations)[:, 0]
        value, value_moments = minimise(value_loss, value, value_moments, settings.rate)
        target = rewards + settings.discount * (1.0 - ended) * next_values

        def critic_loss(critics: Any) -> Any:
            return critic_error(critics, observations, actions, target)

        critics, critic_moments = minimise(critic_loss, critics, critic_moments, settings.rate)
        weight = jnp.minimum(jnp.exp(settings.sharpness * advantage), settings.weight_limit)

        def actor_loss(actor: Any) -> Any:
            network, log_std = actor
            log_std = jnp.clip(log_std, -5.0, 2.0)
            error = (actions - jnp.tanh(forward(network, observations))) / jnp.exp(log_std)
            return (weight * (0.5 * error**2 + log_std).sum(axis=-1)).mean()

        rate = settings.rate * 0.5 * (1.0 + jnp.cos(jnp.pi * number / updates))
        actor, actor_moments = minimise(actor_loss, actor, actor_moments, rate)
        target_critics = follow(target_critics, critics, settings.follow_share)
        moments = (actor_moments, critic_moments, value_moments)
        return number + 1, updates, actor, critics, target_critics, value, moments

    return update
