"""A whole SBX agent (actor, critics, targets, entropy coefficient, optimisers) as plain arrays.

What is stored is safetensors, never a pickle: names are paths in the agent's state, so any part can
be read without SBX. The actor comes out under Stable-Baselines3's names.
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

_LAYERS = {
    "Dense_0": "latent_pi.0",
    "Dense_1": "latent_pi.2",
    "Dense_2": "mu",
    "Dense_3": "log_std",
}
_STATES = ("actor", "qf", "entropy")


def make_agent(env: Any, settings: Hyperparameters, seed: int, device: str | None = None) -> Any:
    """Return a new ``sbx.CrossQ`` on ``env`` (a Gymnasium environment or a vectorised one).

    Args:
        env: what to train in.
        settings: the hyperparameters.
        seed: of all that is random.
        device: where the updates are computed: ``cpu``, ``gpu``, or None for the best that JAX has.

    Raises:
        DependencyError: when SBX is not installed.
        TrainingError: when there is no such device.
    """
    # XLA's threads are no faster on updates this small and would take the other jobs' cores.
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    try:
        import jax
        from sbx import CrossQ
    except ImportError:
        raise missing_dependency("sbx-rl", "train", "training") from None
    if jax.config.jax_compilation_cache_dir is None:
        # A sweep compiles the same few programs for every variant of a robot.
        jax.config.update("jax_compilation_cache_dir", str(policies_folder().parent / "compiled"))
    if device is not None:
        _use(device)
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
            # Without normalisation in the actor it is SAC's, and needs nothing but its weights.
            "batch_norm_actor": False,
            "net_arch": {"pi": [256, 256], "qf": [settings.critic_width] * 2},
        },
        buffer_size=min(settings.max_steps + settings.evaluate_every, 1_000_000),
        seed=seed,
    )


def _use(device: str) -> None:
    """Compute on the first device of a kind from now on, in this process."""
    import jax

    try:
        jax.config.update("jax_default_device", jax.devices(device)[0])
    except RuntimeError:
        there = sorted({found.platform for found in jax.devices()} | {"cpu"})
        raise TrainingError(
            f"JAX has no device {device!r} here; valid: {', '.join(there)} "
            '(for an NVIDIA GPU, `pip install "jax[cuda12]"`)'
        ) from None


def forget_compiled() -> None:
    """Give back what was compiled for agents that are gone, 75 MB each: a sweep has hundreds of them."""
    import jax

    gc.collect()
    jax.clear_caches()


def agent_arrays(agent: Any) -> dict[str, Array]:
    """Return everything that the agent has learnt, by path, as arrays."""
    from flax.serialization import to_state_dict
    from flax.traverse_util import flatten_dict

    flat = flatten_dict({name: to_state_dict(state) for name, state in _states(agent).items()}, sep="/")
    arrays = {path: np.array(value) for path, value in flat.items()}
    return arrays | {"key": np.array(agent.key), "policy_key": np.array(agent.policy.key)}


def restore_agent(agent: Any, arrays: dict[str, Array]) -> None:
    """Give ``agent`` all that :func:`agent_arrays` returned of another.

    Raises:
        PolicyError: when the arrays are of an agent of another shape.
    """
    from flax.serialization import from_state_dict, to_state_dict
    from flax.traverse_util import flatten_dict, unflatten_dict

    restored = {}
    for name, state in _states(agent).items():
        # Parts without any value are no arrays, but belong to the state.
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
    """Write arrays as safetensors, so that at every moment ``path`` holds the old ones or the new."""
    # ascontiguousarray makes a vector of a scalar, and save_file a file that others cannot read.
    contiguous = {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in arrays.items()}
    with whole_file(path) as partial:
        partial.write_bytes(save(contiguous))


def load_arrays(path: Path) -> dict[str, Array]:
    """Read arrays from safetensors.

    Raises:
        PolicyError: when the file is not whole.
    """
    try:
        return dict(load_file(path))
    except Exception as error:  # safetensors raises its own error, and OSError, and ValueError
        raise PolicyError(f"{path}: cannot be read: {error}") from None


def actor_arrays(agent: Any) -> dict[str, Array]:
    """Return the agent's actor under Stable-Baselines3's names, rounded to float16 as it will be shipped."""
    return agent_actor(agent_arrays(agent))


def agent_actor(arrays: dict[str, Array]) -> dict[str, Array]:
    """Return the actor among the arrays of :func:`agent_arrays`, as :func:`actor_arrays` does."""
    actor: dict[str, Array] = {}
    for ours, theirs in _LAYERS.items():
        actor[f"{theirs}.weight"] = arrays[f"actor/params/{ours}/kernel"].astype(np.float16).T
        actor[f"{theirs}.bias"] = arrays[f"actor/params/{ours}/bias"].astype(np.float16)
    return actor


def actor_of(arrays: dict[str, Array], algorithm: str) -> Actor:
    """Return the policy that the arrays of :func:`actor_arrays` are, acting deterministically."""
    return Actor({name: array.astype(np.float32) for name, array in arrays.items()}, algorithm)


def _states(agent: Any) -> dict[str, Any]:
    states = (agent.policy.actor_state, agent.policy.qf_state, agent.ent_coef_state)
    return dict(zip(_STATES, states, strict=True))
