"""The gradient steps: SBX's compiled loop of CrossQ, with an anchor where the settings ask for one."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from imujoco_minari.policies import Array
from imujoco_minari.policies.actors import LOG_STD_RANGE, depth


def actor_outputs(weights: Mapping[str, Any], inputs: Any) -> tuple[Any, Any]:
    """Return modes, in [-1, 1], and log deviations of an actor with ReLU, computed by JAX."""
    import jax
    import jax.numpy as jnp

    def layer(name: str, x: Any) -> Any:
        return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]

    for number in range(depth(weights)):
        inputs = jax.nn.relu(layer(f"latent_pi.{2 * number}", inputs))
    return jnp.tanh(layer("mu", inputs)), jnp.clip(layer("log_std", inputs), *LOG_STD_RANGE)


def hold(agent: Any, anchor: Mapping[str, Array], alpha: float) -> None:
    """Hold an agent's actor near a policy, as TD3+BC holds a policy to data (Fujimoto and Gu 2021).

    The actor's loss has another term: ``mean|Q| / alpha`` times the squared distance between the modes of
    actor and anchor. ``anchor`` is the policy's weights, under Stable-Baselines3's names.
    """
    import jax.numpy as jnp

    state_class, _ = _anchored()
    own = agent.policy.actor_state
    fixed = {name: jnp.asarray(array, jnp.float32) for name, array in anchor.items()}
    agent.policy.actor_state = state_class(**vars(own), anchor=fixed, alpha=jnp.float32(alpha))


@cache
def _anchored() -> tuple[Any, Any]:
    """Return the class of an actor's state with an anchor, and the update loop for it."""
    import jax
    import jax.numpy as jnp
    from flax import struct
    from sbx import CrossQ
    from sbx.common.type_aliases import BatchNormTrainState

    class AnchoredState(BatchNormTrainState):  # type: ignore[misc]
        anchor: Any = struct.field(default=None)
        alpha: Any = struct.field(default=None)

    class AnchoredCrossQ(CrossQ):  # type: ignore[misc]
        @staticmethod
        @jax.jit  # type: ignore[untyped-decorator]
        def update_actor(
            actor_state: Any, qf_state: Any, ent_coef_state: Any, observations: Any, key: Any
        ) -> Any:
            key, dropout_key, noise_key = jax.random.split(key, 3)

            def loss(params: Any) -> Any:
                chosen = actor_state.apply_fn(
                    {"params": params, "batch_stats": actor_state.batch_stats}, observations, train=False
                )
                actions = chosen.sample(seed=noise_key)
                log_prob = chosen.log_prob(actions).reshape(-1, 1)
                values = qf_state.apply_fn(
                    {"params": qf_state.params, "batch_stats": qf_state.batch_stats},
                    observations,
                    actions,
                    rngs={"dropout": dropout_key},
                    train=False,
                )
                lowest = jnp.min(values, axis=0)
                entropy = ent_coef_state.apply_fn({"params": ent_coef_state.params})
                anchored, _ = actor_outputs(actor_state.anchor, observations)
                away = ((chosen.mode() - anchored) ** 2).mean()
                weight = jax.lax.stop_gradient(jnp.abs(lowest).mean()) / actor_state.alpha
                return (entropy * log_prob - lowest).mean() + weight * away, -log_prob.mean()

            (value, entropy), gradient = jax.value_and_grad(loss, has_aux=True)(actor_state.params)
            return actor_state.apply_gradients(grads=gradient), qf_state, value, key, entropy

    return AnchoredState, AnchoredCrossQ._train


def update(agent: Any, data: Any, count: int, delay: int, offset: int) -> None:
    """Make ``count`` gradient steps of an agent, one for each equal part of the data.

    The actor makes a step for each ``delay`` steps of the critics; ``offset`` is the number of the first.
    """
    policy = agent.policy
    loop = _anchored()[1] if hasattr(policy.actor_state, "anchor") else agent._train
    policy.qf_state, policy.actor_state, agent.ent_coef_state, agent.key, _ = loop(
        agent.target_entropy,
        count,
        data,
        delay,
        offset,
        policy.qf_state,
        policy.actor_state,
        agent.ent_coef_state,
        agent.key,
    )


def set_rates(agent: Any, rate: float) -> None:
    """Set the learning rate of actor, critics and entropy coefficient. Nothing is compiled again."""
    import jax.numpy as jnp

    for state in (agent.policy.actor_state, agent.policy.qf_state, agent.ent_coef_state):
        state.opt_state.hyperparams["learning_rate"] = jnp.asarray(rate, jnp.float32)
