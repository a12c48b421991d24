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
    new_critics,
    run_updates,
    transition_data,
    values,
)
from imujoco_minari.benchmark.networks import (
    HIDDEN,
    Initial,
    Update,
    forward,
    import_optax,
    learner,
    minimised,
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
        actor = {"network": policy, "log_std": np.zeros(action, np.float32)}
        critics = new_critics(observation, action, self.seed, self.initial)
        value = new_network((observation, *HIDDEN, 1), self.seed + 3000, self.initial)
        # As in the paper: the returns of the episodes span 1000.
        spread = float(np.ptp(data.returns))
        scaled = transition_data(data, statistics, 1000.0 / spread if spread else 1.0)
        state = (
            learner(actor, self.rate, decay_steps=max(self.checkpoints)),
            learner(critics, self.rate),
            learner(value, self.rate),
            critics,
        )
        states = run_updates(self, _update, state, scaled)
        return {
            updates: to_actor(actor.params["network"], statistics, "IQL")
            for updates, (actor, *_) in states.items()
        }


@cache
def _update(settings: Iql) -> Update:
    jnp, optax = import_jax().numpy, import_optax()

    def update(state: Any, key: Any, data: Any) -> Any:
        actor, critics, value, target_critics = state
        observations, actions, rewards, following, ended = draw_transitions(key, data, settings.batch)
        least = jnp.minimum(*values(target_critics, observations, actions))
        advantage = least - forward(value.params, observations)[:, 0]

        def value_loss(network: Any) -> Any:
            advantage = least - forward(network, observations)[:, 0]
            weight = jnp.where(advantage > 0, settings.expectile, 1.0 - settings.expectile)
            return (weight * advantage**2).mean()

        next_values = forward(value.params, following)[:, 0]
        target = rewards + settings.discount * (1.0 - ended) * next_values
        weight = jnp.minimum(jnp.exp(settings.sharpness * advantage), settings.weight_limit)

        def actor_loss(own: Any) -> Any:
            log_std = jnp.clip(own["log_std"], -5.0, 2.0)
            error = (actions - jnp.tanh(forward(own["network"], observations))) / jnp.exp(log_std)
            return (weight * (0.5 * error**2 + log_std).sum(axis=-1)).mean()

        actor = minimised(actor, actor_loss)
        critics = minimised(critics, lambda own: critic_error(own, observations, actions, target))
        value = minimised(value, value_loss)
        target_critics = optax.incremental_update(critics.params, target_critics, settings.follow_share)
        return actor, critics, value, target_critics

    return update
