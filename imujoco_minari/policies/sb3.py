"""An actor as a Stable-Baselines3 zip, for those who work with ``SAC.load`` and ``SAC.predict``."""

from __future__ import annotations

from pathlib import Path

from imujoco_minari.envs.registration import make
from imujoco_minari.errors import PolicyError
from imujoco_minari.policies import Actor, expert_actor
from imujoco_minari.storage.targets import new_target
from imujoco_minari.variants import Variant


def export_zip(variant: Variant, path: Path, actor: Actor | None = None, *, force: bool = False) -> Path:
    """Write an actor as a zip that ``stable_baselines3.SAC.load`` opens, and return its path.

    The critics in it are new and untrained: only actors are shipped.

    Args:
        variant: the variant whose spaces the zip states.
        path: the zip to write; ``.zip`` is added where it is missing.
        actor: the actor; None takes the variant's expert.
        force: replace a zip that this function wrote before; nothing else is replaced.

    Raises:
        DatasetExistsError: when ``path`` is there already, and ``force`` is false or does not apply.
        PolicyNotFoundError: when there is no expert for the variant.
        PolicyError: when the actor does not fit the variant's robot.
        StorageError: when the file cannot be written.
    """
    import torch
    from stable_baselines3 import SAC

    actor = expert_actor(variant) if actor is None else actor
    actor.check(variant.robot)
    activation = getattr(torch.nn, actor.activation)
    widths = [
        int(actor.weights[f"latent_pi.{2 * i}.bias"].shape[0])
        for i in range(sum(name.startswith("latent_pi") for name in actor.weights) // 2)
    ]
    env = make(variant)
    # One transition is the least that a buffer holds; the exported agent brings none.
    model = SAC(
        "MlpPolicy", env, buffer_size=1, policy_kwargs={"net_arch": widths, "activation_fn": activation}
    )
    state = {name: torch.from_numpy(array.copy()) for name, array in actor.weights.items()}
    try:
        model.actor.load_state_dict(state, strict=True)
    except RuntimeError as error:
        raise PolicyError(f"the actor does not fit SAC's: {error}") from None
    path = path if path.suffix == ".zip" else path.with_suffix(path.suffix + ".zip")
    try:
        with new_target(path, force=force) as staged:
            model.save(staged)
    finally:
        env.close()
    return path
