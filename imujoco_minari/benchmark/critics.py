"""The offline algorithms with critics: TD3+BC and implicit Q-learning."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from imujoco_minari.benchmark.cloning import robust_statistics
from imujoco_minari.benchmark.networks import (
    HIDDEN,
    Initial,
    Network,
    forward,
    import_optax,
    iterate,
    learner,
    minimised,
    new_network,
    new_policy,
    padded,
    to_actor,
)
from imujoco_minari.loading import Arrays
from imujoco_minari.policies import Actor
from imujoco_minari.training.agents import import_jax


@dataclass(frozen=True)
class ActorCritic(ABC):
    """An algorithm with an actor and two critics.

    Attributes:
        seed: seed of the weights, the batches and the noise.
        checkpoints: numbers of updates after which the policy is kept.
        rate: learning rate.
        batch: rows of a batch.
        discount: discount factor.
        follow_share: share by which a target network follows at each of its updates.
        initial: distribution of the initial weights.
    """

    seed: int
    checkpoints: tuple[int, ...]
    rate: float = 3e-4
    batch: int = 128
    discount: float = 0.99
    follow_share: float = 0.005
    initial: Initial = "pytorch"
    name: ClassVar[str]

    def train(self, data: Arrays) -> dict[int, Actor]:
        """Return the policy at each checkpoint."""
        statistics = robust_statistics(data.observations)
        observation, action = data.observations.shape[1], data.actions.shape[1]
        sizes = (observation + action, *HIDDEN, 1)
        policy = new_policy(data.observations, data.actions, self.seed, self.initial)
        critics = tuple(new_network(sizes, self.seed + more, self.initial) for more in (1000, 2000))
        columns = (
            statistics.normalize(data.observations),
            data.actions,
            data.rewards * self.reward_scale(data),
            statistics.normalize(data.next_observations),
            data.terminations,
        )
        padded_data = (*map(padded, columns), np.int32(len(data)))
        state = self.first_state(policy, critics)
        # All seeds use one compiled program.
        update = replace(self, seed=0, checkpoints=())
        states = iterate(update, state, padded_data, self.checkpoints, self.seed)
        return {
            updates: to_actor(actor.params["network"], statistics, self.name)
            for updates, (actor, *_) in states.items()
        }

    def reward_scale(self, data: Arrays) -> float:
        """Return the factor of the rewards."""
        return 1.0

    @abstractmethod
    def first_state(self, policy: Network, critics: Any) -> Any:
        """Return the state before the first update. Its first part is the learner of the actor."""

    @abstractmethod
    def __call__(self, state: Any, key: Any, data: Any) -> Any:
        """Return the next state."""


@dataclass(frozen=True)
class Td3Bc(ActorCritic):
    """TD3+BC (Fujimoto and Gu, 2021) with the paper's hyperparameters, but half its batch.

    The actor is drawn to the actions of the data. The critics are updated each time; the actor and the target
    networks are updated every second time.

    Attributes:
        noise: standard deviation of the noise on the target's actions.
        noise_limit: largest noise on the target's actions.
        weight: weight of the critic's value, relative to its mean size, against the imitation.
    """

    noise: float = 0.2
    noise_limit: float = 0.5
    weight: float = 2.5
    name: ClassVar[str] = "TD3+BC"

    def first_state(self, policy: Network, critics: Any) -> Any:
        """Return actor and critics, and the networks that follow them."""
        actor = {"network": policy}
        return learner(actor, self.rate), learner(critics, self.rate), actor, critics

    def __call__(self, state: Any, key: Any, data: Any) -> Any:
        """Return the next state."""
        jax, optax = import_jax(), import_optax()
        jnp = jax.numpy

        def act(actor: Any, observations: Any) -> Any:
            return jnp.tanh(forward(actor["network"], observations))

        actor, critics, target_actor, target_critics = state
        draw, blur = jax.random.split(key)
        observations, actions, rewards, following, ended = _draw_transitions(draw, data, self.batch)
        noise = self.noise * jax.random.normal(blur, actions.shape)
        noise = jnp.clip(noise, -self.noise_limit, self.noise_limit)
        next_actions = jnp.clip(act(target_actor, following) + noise, -1.0, 1.0)
        least = jnp.minimum(*_values(target_critics, following, next_actions))
        target = rewards + self.discount * (1.0 - ended) * least
        critics = minimised(critics, lambda own: _critic_error(own, observations, actions, target))

        def actor_loss(own: Any) -> Any:
            chosen = act(own, observations)
            value, _ = _values(critics.params, observations, chosen)
            scale = self.weight / jax.lax.stop_gradient(jnp.abs(value).mean())
            return -scale * value.mean() + ((chosen - actions) ** 2).mean()

        def with_actor(actor: Any, *targets: Any) -> Any:
            actor = minimised(actor, actor_loss)
            newest = (actor.params, critics.params)
            return actor, *optax.incremental_update(newest, targets, self.follow_share)

        actor, *targets = jax.lax.cond(
            critics.step % 2 == 0, with_actor, lambda *parts: parts, actor, target_actor, target_critics
        )
        return actor, critics, *targets


@dataclass(frozen=True)
class Iql(ActorCritic):
    """Implicit Q-learning (Kostrikov and others, 2021): it learns from the values of the data's own actions.

    It has the paper's hyperparameters for locomotion, but half its batch. The rate of the actor falls by a
    cosine, to 0 at the last checkpoint.

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

    def __call__(self, state: Any, key: Any, data: Any) -> Any:
        """Return the next state."""
        jnp, optax = import_jax().numpy, import_optax()
        actor, critics, value, target_critics = state
        observations, actions, rewards, following, ended = _draw_transitions(key, data, self.batch)
        least = jnp.minimum(*_values(target_critics, observations, actions))
        advantage = least - forward(value.params, observations)[:, 0]

        def value_loss(network: Any) -> Any:
            advantage = least - forward(network, observations)[:, 0]
            weight = jnp.where(advantage > 0, self.expectile, 1.0 - self.expectile)
            return (weight * advantage**2).mean()

        next_values = forward(value.params, following)[:, 0]
        target = rewards + self.discount * (1.0 - ended) * next_values
        weight = jnp.minimum(jnp.exp(self.sharpness * advantage), self.weight_limit)

        def actor_loss(own: Any) -> Any:
            log_std = jnp.clip(own["log_std"], -5.0, 2.0)
            error = (actions - jnp.tanh(forward(own["network"], observations))) / jnp.exp(log_std)
            return (weight * (0.5 * error**2 + log_std).sum(axis=-1)).mean()

        actor = minimised(actor, actor_loss)
        critics = minimised(critics, lambda own: _critic_error(own, observations, actions, target))
        value = minimised(value, value_loss)
        target_critics = optax.incremental_update(critics.params, target_critics, self.follow_share)
        return actor, critics, value, target_critics


def _draw_transitions(key: Any, data: tuple[Any, ...], batch: int) -> tuple[Any, ...]:
    """Return random observations, actions, rewards, next observations and terminations, with replacement."""
    *columns, rows = data
    chosen = import_jax().random.randint(key, (batch,), 0, rows)
    return tuple(column[chosen] for column in columns)


def _values(critics: tuple[Network, Network], observations: Any, actions: Any) -> tuple[Any, Any]:
    """Return the values (batch,) of actions by both critics."""
    inputs = import_jax().numpy.concatenate((observations, actions), axis=-1)
    first, second = critics
    return forward(first, inputs)[:, 0], forward(second, inputs)[:, 0]


def _critic_error(critics: tuple[Network, Network], observations: Any, actions: Any, target: Any) -> Any:
    """Return the sum of both critics' mean squared errors to the target values."""
    first, second = _values(critics, observations, actions)
    return ((first - target) ** 2).mean() + ((second - target) ** 2).mean()
