"""Experts and their training records: those that the user has trained, and those that the package ships.

A user's file takes precedence over a shipped file of the same name.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from imujoco_minari.errors import PolicyError, PolicyNotFoundError, VariantError
from imujoco_minari.policies.actors import Actor
from imujoco_minari.policies.files import actor_of_bytes
from imujoco_minari.variants import Variant


def expert_actor(variant: Variant, *, deterministic: bool = True) -> Actor:
    """Return the expert actor of a variant.

    Args:
        variant: the variant that the expert was trained on.
        deterministic: whether the actor takes the mode of its distribution, or a sample.

    Raises:
        PolicyNotFoundError: if neither the user nor the package has an expert for the variant.
        PolicyError: if its files are damaged.
    """
    record = expert_record(variant)
    if not record:
        raise PolicyNotFoundError(
            f"no expert policy exists for {variant}: train one with `imujoco train {variant}`, or give one "
            f"with --policy FILE; `imujoco policies` lists the {len(expert_variants())} that exist"
        )
    path = find_policy_file(f"{variant}.safetensors")
    if path is None:
        raise PolicyNotFoundError(f"{variant} has a training record, but {variant}.safetensors is missing")
    actor = actor_of_bytes(path.read_bytes(), path.name, record["algorithm"], deterministic, record)
    return actor.for_robot(variant.robot)


def expert_record(variant: Variant, folder: Path | None = None) -> Mapping[str, Any]:
    """Return the training record of a variant's expert, or an empty mapping when it has no expert.

    Args:
        variant: the variant that the expert was trained on.
        folder: folder to search before the package's; None means :func:`policies_folder`.

    Raises:
        PolicyError: if the record cannot be read.
    """
    path = find_policy_file(f"{variant}.json", folder)
    if path is None:
        return {}
    try:
        record = json.loads(path.read_text("utf-8"))
    except ValueError as error:
        raise PolicyError(f"{path}: not a training record: {error}") from None
    if not isinstance(record, dict):
        raise PolicyError(f"{path}: not a training record: no JSON object")
    return record


def expert_variants(folder: Path | None = None) -> tuple[Variant, ...]:
    """Return the variants that have an expert policy of the user or of the package, sorted.

    Args:
        folder: folder to search before the package's; None means :func:`policies_folder`.
    """
    names = {path.stem for place in _places(folder) if place.is_dir() for path in place.glob("*-*.json")}
    found = []
    for name in names:
        if name.endswith(".agent"):
            continue
        # The user may have policies of robots whose pages are not loaded now.
        with suppress(VariantError):
            found.append(Variant.parse(name))
    return tuple(sorted(found))


def agent_file(name: Variant | str, folder: Path | None = None) -> Path | None:
    """Return the file of an agent (actor, critics, optimiser) that training can start from, or None.

    Args:
        name: a base, or ``<robot>-all`` for the agent that was trained on all variants of a robot.
        folder: folder to search before the package's; None means :func:`policies_folder`.
    """
    return find_policy_file(f"{name}.agent.safetensors", folder)


def policies_folder() -> Path:
    """Return the folder of the user's policies: ``$IMUJOCO_HOME/policies``, or ``~/.imujoco/policies``."""
    home = os.environ.get("IMUJOCO_HOME")
    return (Path(home) if home else Path.home() / ".imujoco") / "policies"


def shipped_folder() -> Path:
    """Return the folder of the policies that the package ships."""
    return Path(__file__).parents[1] / "weights"


def _places(folder: Path | None) -> tuple[Path, Path]:
    """Return the folders to search for policies, in order."""
    return (policies_folder() if folder is None else folder), shipped_folder()


def find_policy_file(name: str, folder: Path | None = None) -> Path | None:
    """Return the path of a file in ``folder`` or in the package, or None.

    A ``folder`` of None means :func:`policies_folder`.
    """
    return next((place / name for place in _places(folder) if (place / name).is_file()), None)
