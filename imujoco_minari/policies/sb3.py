"""Exports an actor as a Stable-Baselines3 zip for ``SAC.load`` and ``SAC.predict``."""

from __future__ import annotations

from pathlib import Path

from imujoco_minari.envs.registration import make
from imujoco_minari.errors import PolicyError
from imujoco_minari.policies import Actor, expert_actor
from imujoco_minari.storage.targets import new_target
from imujoco_minari.variants import Variant


def export_zip(variant: Variant, path: Path, actor: Actor | None = None, *, force: bool = False) -> Path:
    """Write an actor as a zip that ``stable_baselines3.SAC.load`` reads, and return its path.

    The critics in it are new and untrained, because only actors are shipped.

    Args:
        variant: the variant whose spaces the zip states.
        path: the zip to write. ``.zip`` is added if it is missing.
        actor: the actor; None for the variant's expert.
        force: replace a zip that this function wrote before. No other file is replaced.

    Raises:
        DatasetExistsError: if ``path`` exists, and ``force`` is false or the file is not an export.
        PolicyNotFoundError: if the variant has no expert.
        PolicyError: if the actor does not fit the variant's robot.
        StorageError: if the file cannot be written.

    Example:
        >>> export_zip(Variant.parse("hopper-base"), Path("hopper.zip"))
        PosixPath('hopper.zip')
    """
    import torch
    from stable_baselines3 import SAC

    actor = expert_actor(variant) if actor is None else actor
    actor.check(variant.robot)
    activation = getattr(torch.nn, actor.activation)
    env = make(variant)
    # The smallest buffer, because the exported agent has no transitions.
    model = SAC(
        "MlpPolicy",
        env,
        buffer_size=1,
        policy_kwargs={"net_arch": actor.hidden_sizes, "activation_fn": activation},
    )
    state = {name: torch.from_numpy(array.copy()) for name, array in actor.weights.items()}
    try:
        model.actor.load_state_dict(state, strict=True)
    except RuntimeError as error:
        raise PolicyError(f"the actor does not fit SAC's network: {error}") from None
    # `SAC.load` makes a buffer of this size, the usual one, so training can go on.
    model.buffer_size = 1_000_000
    path = path if path.suffix == ".zip" else path.with_suffix(path.suffix + ".zip")
    try:
        with new_target(path, force=force) as staged:
            model.save(staged)
    finally:
        env.close()
    return path
