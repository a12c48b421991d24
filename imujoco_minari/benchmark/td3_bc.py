"""TD3+BC (Fujimoto and Gu, 2021): twin critics, and an actor that is drawn to the actions of the data."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

from imujoco_minari.benchmark.critics import ActorCritic, critic_error, draw_transitions, values
from imujoco_minari.benchmark.networks import (
    Network,
    Update,
    forward,
    import_optax,
    learner,
    minimised,
)
from imujoco_minari.training.agents import import_jax


@dataclass(frozen=True)
class Td3Bc(ActorCritic):
    """TD3+BC with the paper's hyperparameters, but half its batch.

    The critics are updated each time; the actor and the target networks are updated every second time.

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

    def update(self) -> Update:
        """Return the update of the state."""
        return _update(self)


@cache
def _update(settings: Td3Bc) -> Update:
    jax, optax = import_jax(), import_optax()
    jnp = jax.numpy

    def act(actor: Any, observations: Any) -> Any:
        return jnp.tanh(forward(actor["network"], observations))

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

        def actor_loss(own: Any) -> Any:
            chosen = act(own, observations)
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
