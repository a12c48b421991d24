"""TD3+BC (Fujimoto and Gu, 2021): twin critics, and an actor that is drawn to the actions of the data."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

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
    Initial,
    Update,
    forward,
    import_optax,
    learner,
    minimised,
    new_policy,
    to_actor,
)
from imujoco_minari.loading import Arrays
from imujoco_minari.policies import Actor
from imujoco_minari.training.agents import import_jax


@dataclass(frozen=True)
class Td3Bc:
    """TD3+BC with the paper's hyperparameters, but half its batch.

    Attributes:
        seed: seed of the weights, the batches and the noise.
        checkpoints: numbers of updates after which the policy is kept. The critics are updated each time, and
            the actor every second time.
        rate: learning rate.
        batch: rows of a batch.
        discount: discount factor.
        follow_share: share by which a target network follows at each update of the actor.
        noise: standard deviation of the noise on the target's actions.
        noise_limit: largest noise on the target's actions.
        weight: weight of the critic's value, relative to its mean size, against the imitation.
        initial: distribution of the initial weights.
    """

    seed: int
    checkpoints: tuple[int, ...]
    rate: float = 3e-4
    batch: int = 128
    discount: float = 0.99
    follow_share: float = 0.005
    noise: float = 0.2
    noise_limit: float = 0.5
    weight: float = 2.5
    initial: Initial = "pytorch"

    def train(self, data: Arrays) -> dict[int, Actor]:
        """Return the policy at each checkpoint."""
        statistics = robust_statistics(data.observations)
        observation, action = data.observations.shape[1], data.actions.shape[1]
        actor = new_policy(data.observations, data.actions, self.seed, self.initial)
        critics = new_critics(observation, action, self.seed, self.initial)
        state = (learner(actor, self.rate), learner(critics, self.rate), actor, critics)
        states = run_updates(self, _update, state, transition_data(data, statistics))
        return {
            updates: to_actor(actor.params, statistics, "TD3+BC") for updates, (actor, *_) in states.items()
        }


@cache
def _update(settings: Td3Bc) -> Update:
    jax, optax = import_jax(), import_optax()
    jnp = jax.numpy

    def act(network: Any, observations: Any) -> Any:
        return jnp.tanh(forward(network, observations))

    def update(state: Any, key: Any, data: Any) -> Any:
        actor, critics, target_actor, target_critics = state
        draw, blur = jax.random.split(key)
        observations, actions, rewards, following, ended = draw_transitions(draw, data, settings.batch)
        noise = settings.noise * jax.random.normal(blur, actions.shape)
        noise = jnp.clip(noise, -settings.noise_limit, settings.noise_limit)
        next_actions = jnp.clip(act(target_actor, following) + noise, -1.0, 1.0)
        least = jnp.minimum(*values(target_critics, following, next_actions))
        target = rewards + settings.discount * (1.0 - ended) * least
        critics = minimised(critics, lambda own: critic_error(own, observations, actions, target))

        def actor_loss(network: Any) -> Any:
            chosen = act(network, observations)
            value, _ = values(critics.params, observations, chosen)
            scale = settings.weight / jax.lax.stop_gradient(jnp.abs(value).mean())
            return -scale * value.mean() + ((chosen - actions) ** 2).mean()

        def with_actor(actor: Any, *targets: Any) -> Any:
            actor = minimised(actor, actor_loss)
            newest = (actor.params, critics.params)
            return actor, *optax.incremental_update(newest, targets, settings.follow_share)

        actor, *targets = jax.lax.cond(
            critics.step % 2 == 0, with_actor, lambda *parts: parts, actor, target_actor, target_critics
        )
        return actor, critics, *targets

    return update
