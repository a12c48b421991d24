"""A complete SBX agent (actor, critics, entropy coefficient, optimisers) as plain arrays.

Agents are stored as safetensors, never as pickles. The names are paths in the agent's state, so any part can
be read without SBX. The actor is returned under Stable-Baselines3's names.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from safetensors.numpy import load_file, save

from imujoco_minari.errors import PolicyError, TrainingError, missing_dependency
from imujoco_minari.policies import Actor, Array, policies_folder
from imujoco_minari.storage.files import whole_file
from imujoco_minari.training.hyperparameters import Hyperparameters

ALGORITHM = "CrossQ"
# The parts of an agent that a new run starts from. The optimisers begin anew.
CRITICS = ("qf/params", "qf/batch_stats", "entropy/params")
STARTING = ("actor/params/Dense", *CRITICS)
# The actor's arrays: Stable-Baselines3's name -> place in its parameters. A weight is a kernel transposed.
_ACTOR = {
    f"{name}.{part}": (f"Dense_{number}", kind)
    for number, name in enumerate(("latent_pi.0", "latent_pi.2", "mu", "log_std"))
    for part, kind in (("weight", "kernel"), ("bias", "bias"))
}
_FUNCTIONS: dict[tuple[Any, ...], dict[str, dict[str, Any]]] = {}


class _Spaces(gym.Env[Any, Any]):
    """An environment that has spaces only, because an agent is made for one."""

    def __init__(self, inputs: int, actions: int) -> None:
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (inputs,))
        self.action_space = gym.spaces.Box(-1, 1, (actions,))


def make_agent(
    inputs: int, actions: int, settings: Hyperparameters, seed: int, device: str | None = None
) -> Any:
    """Return a new ``sbx.CrossQ``.

    Args:
        inputs: length of an input: observation and context.
        actions: length of an action, whose entries are in [-1, 1].
        settings: the hyperparameters.
        seed: seed of the weights and of the updates.
        device: device of the updates: ``cpu``, ``gpu``, or None for JAX's default.

    Raises:
        DependencyError: if SBX is not installed.
        TrainingError: if JAX has no such device.
    """
    import_jax()
    try:
        import optax
        from sbx import CrossQ
    except ImportError:
        raise missing_dependency("sbx-rl", "train", "training") from None
    if device is not None:
        _set_default_device(device)
    # The rate is part of the optimisers' state, so a new rate compiles nothing again.
    adam = optax.inject_hyperparams(optax.adam)
    agent = CrossQ(
        "MlpPolicy",
        _Spaces(inputs, actions),
        learning_rate=settings.learning_rate,
        gamma=settings.gamma,
        policy_kwargs={
            # Without normalisation the actor is SAC's and consists of its weights alone.
            "batch_norm_actor": False,
            "net_arch": {"pi": [256, 256], "qf": [settings.critic_width] * 2},
            "optimizer_class": adam,
            "optimizer_kwargs": {"b1": settings.momentum},
        },
        # The transitions are in a buffer of our own.
        buffer_size=1,
        seed=seed,
    )
    entropy, optimiser = agent.ent_coef_state, adam(learning_rate=settings.learning_rate)
    agent.ent_coef_state = entropy.replace(tx=optimiser, opt_state=optimiser.init(entropy.params))
    # Compiled programs are those of these functions, so equal agents share them: no second one compiles.
    key = (inputs, actions, settings.critic_width, settings.momentum)
    functions = _FUNCTIONS.setdefault(
        key, {name: {"apply_fn": s.apply_fn, "tx": s.tx} for name, s in _train_states(agent).items()}
    )
    policy = agent.policy
    policy.actor_state = policy.actor_state.replace(**functions["actor"])
    policy.qf_state = policy.qf_state.replace(**functions["qf"])
    agent.ent_coef_state = agent.ent_coef_state.replace(**functions["entropy"])
    return agent


def import_jax() -> Any:
    """Return the module ``jax``, which uses one thread and keeps its compiled programs on the disk.

    Raises:
        DependencyError: if JAX is not installed.
    """
    # XLA makes this many threads. Updates are small: with a thread for each core, they take 1.4 times the
    # processor time and are not faster.
    os.environ.setdefault("NPROC", "1")
    try:
        import jax
    except ImportError:
        raise missing_dependency("jax", "train", "training") from None
    if jax.config.jax_compilation_cache_dir is None:
        # All variants of a robot use the same few compiled programs.
        jax.config.update("jax_compilation_cache_dir", str(policies_folder().parent / "compiled"))
    return jax


def _set_default_device(device: str) -> None:
    import jax

    try:
        jax.config.update("jax_default_device", jax.devices(device)[0])
    except RuntimeError:
        available = sorted({found.platform for found in jax.devices()} | {"cpu"})
        raise TrainingError(
            f"JAX has no device {device!r} here; valid: {', '.join(available)} "
            '(for an NVIDIA GPU, `pip install "jax[cuda12]"`)'
        ) from None


def agent_arrays(agent: Any) -> dict[str, Array]:
    """Return the complete state of an agent as arrays, keyed by their paths in it."""
    from flax.serialization import to_state_dict
    from flax.traverse_util import flatten_dict

    flat = flatten_dict({name: to_state_dict(state) for name, state in _train_states(agent).items()}, sep="/")
    return {path: np.array(value) for path, value in flat.items()} | {"key": np.array(agent.key)}


def restore_agent(agent: Any, arrays: Mapping[str, Array], parts: tuple[str, ...] = ("",)) -> None:
    """Restore the state that :func:`agent_arrays` returned, all of it or the paths that begin with ``parts``.

    Raises:
        PolicyError: if the arrays have other names or shapes than the agent's.
    """
    import jax.numpy as jnp
    from flax.serialization import from_state_dict, to_state_dict
    from flax.traverse_util import flatten_dict, unflatten_dict

    restored = {}
    for name, state in _train_states(agent).items():
        # Empty parts have no arrays but belong to the state.
        own = flatten_dict(to_state_dict(state), sep="/", keep_empty_nodes=True)
        for path in flatten_dict(to_state_dict(state), sep="/"):
            if not f"{name}/{path}".startswith(parts):
                continue
            value = arrays.get(f"{name}/{path}")
            if value is None or value.shape != np.shape(own[path]):
                raise PolicyError(f"the stored agent does not fit: {name}/{path}")
            own[path] = value
        restored[name] = from_state_dict(state, unflatten_dict(own, sep="/"))
    agent.policy.actor_state, agent.policy.qf_state = restored["actor"], restored["qf"]
    agent.ent_coef_state = restored["entropy"]
    if "key".startswith(parts):
        agent.key = jnp.asarray(arrays["key"])


def save_arrays(path: Path, arrays: Mapping[str, Array]) -> None:
    """Write arrays as safetensors. At every moment ``path`` holds either the old arrays or the new."""
    # ascontiguousarray turns a scalar into a vector. save_file would set permissions that others cannot read.
    contiguous = {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in arrays.items()}
    with whole_file(path) as partial:
        partial.write_bytes(save(contiguous))


def load_arrays(path: Path) -> dict[str, Array]:
    """Read arrays from safetensors.

    Raises:
        PolicyError: if the file cannot be read.
    """
    try:
        return dict(load_file(path))
    except Exception as error:  # safetensors raises its own error, and OSError, and ValueError
        raise PolicyError(f"{path}: cannot be read: {error}") from None


def actor_weights(agent: Any) -> dict[str, Array]:
    """Return an agent's actor under Stable-Baselines3's names, float32."""
    params = agent.policy.actor_state.params
    return {name: np.asarray(params[layer][kind]).T for name, (layer, kind) in _ACTOR.items()}


def as_stored(weights: Mapping[str, Array]) -> dict[str, Array]:
    """Return weights as float16, the precision that is stored."""
    return {name: np.asarray(array).astype(np.float16) for name, array in weights.items()}


def agent_actor(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Return the actor from the arrays of :func:`agent_arrays`, as it is stored."""
    return as_stored(
        {name: arrays[f"actor/params/{layer}/{kind}"].T for name, (layer, kind) in _ACTOR.items()}
    )


def replace_actor(arrays: Mapping[str, Array], actor: Mapping[str, Array]) -> dict[str, Array]:
    """Return the arrays of :func:`agent_arrays` with another actor, under Stable-Baselines3's names."""
    return dict(arrays) | {
        f"actor/params/{layer}/{kind}": actor[name].astype(np.float32).T
        for name, (layer, kind) in _ACTOR.items()
    }


def actor_of(arrays: Mapping[str, Array], robot: str) -> Actor:
    """Return the deterministic policy of a robot with stored weights."""
    weights = {name: array.astype(np.float32) for name, array in arrays.items()}
    return Actor(weights, ALGORITHM).for_robot(robot)


def _train_states(agent: Any) -> dict[str, Any]:
    return {"actor": agent.policy.actor_state, "qf": agent.policy.qf_state, "entropy": agent.ent_coef_state}
