"""The gradient steps of CrossQ with an anchor, and the transitions that they take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from imujoco_minari.policies import Array


class TransitionBuffer:
    """Transitions, the oldest replaced first."""

    def __init__(self, size: int, sizes: tuple[int, int]) -> None:
        self._size, self._count = size, 0
        self._inputs = np.zeros((size, sizes[0]), np.float32)
        self._next = np.zeros((size, sizes[0]), np.float32)
        self._actions = np.zeros((size, sizes[1]), np.float32)
        self._rewards, self._dones = np.zeros(size, np.float32), np.zeros(size, np.float32)

    def add(self, inputs: Array, following: Array, action: Array, reward: float, done: bool) -> None:
        """Add a transition."""
        at = self._count % self._size
        self._inputs[at], self._next[at], self._actions[at] = inputs, following, action
        self._rewards[at], self._dones[at] = reward, done
        self._count += 1

    def sample(self, rng: np.random.Generator, count: int, gamma: float) -> Any:
        """Return transitions drawn evenly, in the form of SBX."""
        from sbx.common.type_aliases import ReplayBufferSamplesNp

        at = rng.integers(min(self._count, self._size), size=count)
        return ReplayBufferSamplesNp(
            self._inputs[at],
            self._actions[at],
            self._next[at],
            self._dones[at],
            self._rewards[at],
            np.full(count, gamma, np.float32),
        )


def compiled_act() -> Any:
    """Return the function that samples actions, in [-1, 1], for inputs and noise."""
    import jax
    import jax.numpy as jnp

    def act(params: Any, x: Any, noise: Any) -> Any:
        for layer in ("Dense_0", "Dense_1"):
            x = jax.nn.relu(x @ params[layer]["kernel"] + params[layer]["bias"])
        mean, log_std = (x @ params[head]["kernel"] + params[head]["bias"] for head in ("Dense_2", "Dense_3"))
        return jnp.tanh(mean + jnp.exp(jnp.clip(log_std, -20, 2)) * noise)

    return jax.jit(act)


# The parts of an agent that training goes on from, beside the actor. The optimisers begin anew.
CRITICS = ("qf/params", "qf/batch_stats", "entropy/params")


def with_context(
    own: Mapping[str, Array], agent: Mapping[str, Array], contexts: Array, observations: int
) -> dict[str, Array]:
    """Return the arrays of an agent with the critics of another, which may not be told the context yet.

    Args:
        own: the arrays of a new agent that takes observation and context.
        agent: the arrays of the base's agent, or of an agent like ``own``.
        contexts: of the listed variants; shape (variants, parameters).
        observations: length of an observation.
    """
    arrays = dict(own)
    for name, array in agent.items():
        if not name.startswith(CRITICS):
            continue
        if array.shape == own[name].shape:
            arrays[name] = array
            continue
        # Rows of the context, between those of the observation and of the action.
        before, after = np.split(array, [observations], axis=1)
        rows = np.zeros((array.shape[0], contexts.shape[1], *array.shape[2:]), array.dtype)
        if name.endswith("scale"):
            rows += 1
        elif name.endswith("/mean"):
            rows += contexts.mean(axis=0)
        elif name.endswith("/var"):
            rows += np.maximum(contexts.var(axis=0), 1e-3)
        arrays[name] = np.concatenate([before, rows, after], axis=1)
    return arrays


def anchored_updates(anchor: Mapping[str, Array], alpha: float) -> Any:
    """Return SBX's update loop for CrossQ, with the anchor in the actor's loss.

    Args:
        anchor: the weights of the anchor, under Stable-Baselines3's names.
        alpha: how far the policy may go from the anchor; larger is further.
    """
    import jax
    import jax.numpy as jnp
    from sbx import CrossQ

    fixed = {name: jnp.asarray(array, jnp.float32) for name, array in anchor.items()}

    def anchored_mode(x: Any) -> Any:
        for layer in ("latent_pi.0", "latent_pi.2"):
            x = jax.nn.relu(x @ fixed[f"{layer}.weight"].T + fixed[f"{layer}.bias"])
        return jnp.tanh(x @ fixed["mu.weight"].T + fixed["mu.bias"])

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
                away = ((chosen.mode() - anchored_mode(observations)) ** 2).mean()
                weight = jax.lax.stop_gradient(jnp.abs(lowest).mean()) / alpha
                return (entropy * log_prob - lowest).mean() + weight * away, -log_prob.mean()

            (value, entropy), gradient = jax.value_and_grad(loss, has_aux=True)(actor_state.params)
            return actor_state.apply_gradients(grads=gradient), qf_state, value, key, entropy

    return AnchoredCrossQ._train


def rate_setter(agent: Any) -> Any:
    """Return a function that sets the learning rates of an agent. Its optimisers begin anew.

    The rate is part of the optimisers' state, so a new one compiles nothing again.
    """
    import jax.numpy as jnp
    import optax

    adam = optax.inject_hyperparams(optax.adam)(learning_rate=1e-3)

    def with_rate(state: Any, rate: float) -> Any:
        if state.tx is not adam:
            state = state.replace(tx=adam, opt_state=adam.init(state.params))
        state.opt_state.hyperparams["learning_rate"] = jnp.asarray(rate, jnp.float32)
        return state

    def set_rates(agent: Any, rate: float) -> None:
        policy = agent.policy
        policy.actor_state = with_rate(policy.actor_state, rate)
        policy.qf_state = with_rate(policy.qf_state, rate)
        agent.ent_coef_state = with_rate(agent.ent_coef_state, rate)

    set_rates(agent, 1e-3)
    return set_rates
