"""Implicit Q-learning (Kostrikov and others, 2021): it learns from the values of the data's own actions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np

from imujoco_minari.benchmark.critics import ActorCritic, critic_error, draw_transitions, values
from imujoco_minari.benchmark.networks import (
    HIDDEN,
    Network,
    Update,
    forward,
    import_optax,
    learner,
    minimised,
    new_network,
)
from imujoco_minari.loading import Arrays
from imujoco_minari.training.agents import import_jax


@dataclass(frozen=True)
class Iql(ActorCritic):
    """Implicit Q-learning with the paper's hyperparameters for locomotion, but half its batch.

    The rate of the actor falls by a cosine, to 0 at the last checkpoint.

    Attributes:
        expectile: expectile of the critics' values that the state value learns.
        sharpness: factor of the advantage in the exponent of an action's weight.
        weight_limit: largest weight of an action.
    """

    expectile: float = 0.7
    sharpness: float = 3.0
    weight_limit: float = 100.0
    name: ClassVar[str] = "IQL"

    def reward_scale(self, data: Arrays) -> float:
        """Return the factor with which the returns of the episodes span 1000, as in the paper."""
        spread = float(np.ptp(data.returns))
        return 1000.0 / spread if spread else 1.0

    def first_state(self, policy: Network, critics: Any) -> Any:
        """Return actor, critics and state value, and the critics that follow."""
        observation, action = len(policy[0][0]), len(policy[-1][1])
        actor = {"network": policy, "log_std": np.zeros(action, np.float32)}
        value = new_network((observation, *HIDDEN, 1), self.seed + 3000, self.initial)
        return (
            learner(actor, self.rate, decay_steps=max(self.checkpoints)),
            learner(critics, self.rate),
            learner(value, self.rate),
            critics,
        )

    def update(self) -> Update:
        """Return the update of the state."""
        return _update(self)


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
