"""A complete SBX agent (actor, critics, targets, entropy coefficient, optimisers) as plain arrays.

Agents are stored as safetensors, never as pickles. The names are paths in the agent's state, so any part can
be read without SBX. The actor is returned under Stable-Baselines3's names.
"""

from __future__ import annotations

import gc
import os
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file, save

from imujoco_minari.errors import PolicyError, TrainingError, missing_dependency
from imujoco_minari.policies import Actor, Array, policies_folder
from imujoco_minari.storage.files import whole_file
from imujoco_minari.training.hyperparameters import Hyperparameters

ALGORITHM = "CrossQ"
_LAYERS = {
    "Dense_0": "latent_pi.0",
    "Dense_1": "latent_pi.2",
    "Dense_2": "mu",
    "Dense_3": "log_std",
}


def make_agent(env: Any, settings: Hyperparameters, seed: int, device: str | None = None) -> Any:
    """Return a new ``sbx.CrossQ`` on ``env`` (a Gymnasium environment or a vectorised one).

    Args:
        env: the environment to train in.
        settings: the hyperparameters.
        seed: seed of the weights and of all sampling.
        device: device of the updates: ``cpu``, ``gpu``, or None for JAX's default.

    Raises:
        DependencyError: if SBX is not installed.
        TrainingError: if JAX has no such device.
    """
    import_jax()
    try:
        from sbx import CrossQ
    except ImportError:
        raise missing_dependency("sbx-rl", "train", "training") from None
    if device is not None:
        _set_default_device(device)
    return CrossQ(
        "MlpPolicy",
        env,
        learning_rate=settings.learning_rate,
        learning_starts=0,
        batch_size=settings.batch_size,
        gamma=settings.gamma,
        train_freq=settings.steps_per_call,
        gradient_steps=settings.updates_per_call,
        policy_delay=settings.policy_delay,
        policy_kwargs={
            # Without normalisation the actor is SAC's and consists of its weights alone.
            "batch_norm_actor": False,
            "net_arch": {"pi": [256, 256], "qf": [settings.critic_width] * 2},
        },
        buffer_size=min(settings.max_steps + settings.evaluate_every, 1_000_000),
        seed=seed,
    )


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
    """Make the first device of a kind the default of this process."""
    import jax

    try:
        jax.config.update("jax_default_device", jax.devices(device)[0])
    except RuntimeError:
        available = sorted({found.platform for found in jax.devices()} | {"cpu"})
        raise TrainingError(
            f"JAX has no device {device!r} here; valid: {', '.join(available)} "
            '(for an NVIDIA GPU, `pip install "jax[cuda12]"`)'
        ) from None


def forget_compiled() -> None:
    """Free the compiled programs of closed agents, 75 MB each. A sweep makes hundreds of agents."""
    import jax

    gc.collect()
    jax.clear_caches()


def agent_arrays(agent: Any) -> dict[str, Array]:
    """Return the complete state of an agent as arrays, keyed by their paths in it."""
    from flax.serialization import to_state_dict
    from flax.traverse_util import flatten_dict

    flat = flatten_dict({name: to_state_dict(state) for name, state in _train_states(agent).items()}, sep="/")
    arrays = {path: np.array(value) for path, value in flat.items()}
    return arrays | {"key": np.array(agent.key), "policy_key": np.array(agent.policy.key)}


def restore_agent(agent: Any, arrays: dict[str, Array]) -> None:
    """Restore the state that :func:`agent_arrays` returned into ``agent``.

    Raises:
        PolicyError: if the arrays have other names or shapes than the agent's.
    """
    from flax.serialization import from_state_dict, to_state_dict
    from flax.traverse_util import flatten_dict, unflatten_dict

    restored = {}
    for name, state in _train_states(agent).items():
        # Empty parts have no arrays but belong to the state.
        own = flatten_dict(to_state_dict(state), sep="/", keep_empty_nodes=True)
        for path in flatten_dict(to_state_dict(state), sep="/"):
            value = arrays.get(f"{name}/{path}")
            if value is None or value.shape != np.shape(own[path]):
                raise PolicyError(f"the stored agent does not fit: {name}/{path}")
            own[path] = value
        restored[name] = from_state_dict(state, unflatten_dict(own, sep="/"))
    agent.policy.actor_state, agent.policy.qf_state = restored["actor"], restored["qf"]
    agent.ent_coef_state = restored["entropy"]
    if "key" in arrays:
        import jax.numpy as jnp

        agent.key, agent.policy.key = jnp.asarray(arrays["key"]), jnp.asarray(arrays["policy_key"])


def save_arrays(path: Path, arrays: dict[str, Array]) -> None:
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


def actor_arrays(agent: Any) -> dict[str, Array]:
    """Return an agent's actor under Stable-Baselines3's names, as float16, the precision that is stored."""
    return agent_actor(agent_arrays(agent))


def agent_actor(arrays: dict[str, Array]) -> dict[str, Array]:
    """Return the actor from the arrays of :func:`agent_arrays`, in the form of :func:`actor_arrays`."""
    actor: dict[str, Array] = {}
    for ours, theirs in _LAYERS.items():
        actor[f"{theirs}.weight"] = arrays[f"actor/params/{ours}/kernel"].astype(np.float16).T
        actor[f"{theirs}.bias"] = arrays[f"actor/params/{ours}/bias"].astype(np.float16)
    return actor


def replace_actor(arrays: dict[str, Array], actor: dict[str, Array]) -> dict[str, Array]:
    """Return the arrays of :func:`agent_arrays` with another actor, in the form of :func:`actor_arrays`."""
    replaced = dict(arrays)
    for ours, theirs in _LAYERS.items():
        replaced[f"actor/params/{ours}/kernel"] = actor[f"{theirs}.weight"].astype(np.float32).T
        replaced[f"actor/params/{ours}/bias"] = actor[f"{theirs}.bias"].astype(np.float32)
    return replaced


def actor_of(arrays: dict[str, Array], robot: str) -> Actor:
    """Return the deterministic policy of a robot with the weights of :func:`actor_arrays`."""
    weights = {name: array.astype(np.float32) for name, array in arrays.items()}
    return Actor(weights, ALGORITHM).for_robot(robot)


def _train_states(agent: Any) -> dict[str, Any]:
    return {"actor": agent.policy.actor_state, "qf": agent.policy.qf_state, "entropy": agent.ent_coef_state}
