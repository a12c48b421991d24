"""Which policy makes what: the experts that the user has trained or the package ships, and their records."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from imujoco_minari.errors import PolicyError, PolicyNotFoundError
from imujoco_minari.policies.actors import Actor, Policy, RandomPolicy
from imujoco_minari.policies.files import actor_of_bytes, read_actor
from imujoco_minari.variants import EXPERT, Variant, specification


def load_policy(
    variant: Variant | str, *, tier: str = EXPERT, path: str | Path | None = None, stochastic: bool = False
) -> Policy:
    """Return the policy that makes a variant's data of a tier.

    Args:
        variant: a variant or its id.
        tier: ``expert`` or ``random``; ignored when ``path`` is given.
        path: a Stable-Baselines3 ``.zip`` or an actor's ``.safetensors`` to use instead.
        stochastic: sample actions instead of taking their mode.

    Raises:
        PolicyNotFoundError: when no policy is shipped for the variant and tier, or ``path`` is missing.
        PolicyError: when the file is no policy, or its shape does not fit the robot.
    """
    if isinstance(variant, str):
        variant = Variant.parse(variant)
    if path is not None:
        actor = read_actor(Path(path), deterministic=not stochastic)
        actor.check(variant.robot)
        return actor
    if tier == "random":
        return RandomPolicy(specification(variant.robot).action_size)
    if tier == EXPERT:
        return expert_actor(variant, deterministic=not stochastic)
    raise PolicyNotFoundError(f"no single policy makes the tier {tier!r}; valid: {EXPERT}, random, or a path")


def expert_actor(variant: Variant, *, deterministic: bool = True) -> Actor:
    """Return the expert actor of ``variant``: the user's own, else the one that the package ships.

    Raises:
        PolicyNotFoundError: when there is neither.
    """
    record = expert_record(variant)
    if not record:
        raise PolicyNotFoundError(
            f"there is no expert policy for {variant}: train one with `imujoco train {variant}`, "
            f"or give one with --policy FILE; {len(expert_variants())} are there, see `imujoco policies`"
        )
    path = find_policy_file(f"{variant}.safetensors")
    if path is None:
        raise PolicyNotFoundError(f"the record of {variant} is there, but not its weights")
    return actor_of_bytes(path.read_bytes(), path.name, record["algorithm"], deterministic, record)


def expert_record(variant: Variant, folder: Path | None = None) -> Mapping[str, Any]:
    """Return the training record of a variant's expert; empty when there is none.

    Args:
        variant: whose expert.
        folder: look there and in the package; None looks in the user's policies and in the package.

    Raises:
        PolicyError: when the record cannot be read.
    """
    path = find_policy_file(f"{variant}.json", folder)
    if path is None:
        return {}
    try:
        record: Mapping[str, Any] = json.loads(path.read_text("utf-8"))
    except ValueError as error:
        raise PolicyError(f"{path}: not a training record: {error}") from None
    return record


def expert_variants() -> tuple[Variant, ...]:
    """Return the variants that have an expert policy, the user's or shipped, sorted."""
    names = {path.name for place in _places(None) if place.is_dir() for path in place.glob("*-*.json")}
    return tuple(
        sorted(
            Variant.parse(name.removesuffix(".json")) for name in names if not name.endswith(".agent.json")
        )
    )


def agent_file(name: Variant | str, folder: Path | None = None) -> Path | None:
    """Return the file of a whole agent that variants start from, or None.

    Args:
        name: a base, or ``<robot>-all`` for the agent that was trained over all of a robot's variants.
        folder: look there and in the package; None looks in the user's policies and in the package.
    """
    return find_policy_file(f"{name}.agent.safetensors", folder)


def policies_folder() -> Path:
    """Return the folder of the user's policies: ``$IMUJOCO_HOME/policies``, or ``~/.imujoco/policies``."""
    home = os.environ.get("IMUJOCO_HOME")
    return (Path(home) if home else Path.home() / ".imujoco") / "policies"


def shipped_folder() -> Path:
    """Return the folder of the policies that the package ships."""
    return Path(str(resources.files("imujoco_minari") / "weights"))


def _places(folder: Path | None) -> tuple[Path, Path]:
    """Return where policies are looked for, first choice first."""
    return (policies_folder() if folder is None else folder), shipped_folder()


def find_policy_file(name: str, folder: Path | None = None) -> Path | None:
    """Return the file ``name`` among the user's policies (or in ``folder``), else the shipped, or None."""
    return next((place / name for place in _places(folder) if (place / name).is_file()), None)
