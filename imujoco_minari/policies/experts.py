"""The expert of a variant: its own, or else the universal policy of its robot, told the variant.

An expert is *own* if it was trained on the variant alone. It then has a file and a training record. The
*folded* policy needs neither, so every variant of a robot with a universal policy has an expert. A user's
file takes precedence over a shipped file of the same name.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from imujoco_minari.errors import PolicyError, PolicyNotFoundError, PolicyWarning, StorageError, VariantError
from imujoco_minari.policies.actors import Actor
from imujoco_minari.policies.files import read_actor
from imujoco_minari.policies.records import read_measured, read_own_record
from imujoco_minari.policies.universal import UniversalPolicy, read_universal, universal_name
from imujoco_minari.storage.files import write_json
from imujoco_minari.variants import Variant

# What the record of a folded expert states as its `start`.
FOLDED = "universal policy"


def expert_actor(variant: Variant, *, deterministic: bool = True, folder: Path | None = None) -> Actor:
    """Return the expert of a variant: its own, or else the folded one.

    Args:
        variant: the variant.
        deterministic: whether the actor takes the mode of its distribution, or a sample.
        folder: searched in place of :func:`policies_folder`, before the package's.

    Raises:
        PolicyNotFoundError: if the variant has no expert of its own and its robot has no universal policy.
        PolicyError: if the files are damaged.
    """
    record = expert_record(variant, folder)
    if not record:
        raise PolicyNotFoundError(
            f"no expert policy exists for {variant}: train one with `imujoco train {variant}`, or give "
            "one with --policy FILE; `imujoco policies` lists those that exist"
        )
    if is_folded(record) and (universal := universal_policy(variant.robot, folder)):
        return replace(universal.fold(variant), deterministic=deterministic, record=record)
    path = find_policy_file(f"{variant}.safetensors", folder)
    if path is None:
        raise PolicyNotFoundError(f"{variant} has a training record, but {variant}.safetensors is missing")
    actor = read_actor(path, deterministic=deterministic, algorithm=record["algorithm"])
    if actor.sha256 != record["weights_sha256"]:
        raise PolicyError(f"{path}: these are not the weights that {variant}.json is the record of")
    return replace(actor, record=record).for_robot(variant.robot)


def expert_record(variant: Variant, folder: Path | None = None) -> Mapping[str, Any]:
    """Return the record of a variant's expert, or an empty mapping when it has no expert.

    The record of an own expert is that of its training. The record of a folded expert states the digest of
    the universal policy and what it was told, and the evaluations that are known:
    :func:`~imujoco_minari.policies.references.measured_record` makes them.

    ``folder`` is searched in place of :func:`policies_folder`, before the package's.

    Raises:
        PolicyError: if the record cannot be read.
    """
    record = dict(own_record(variant, folder)) or _folded_record(variant, folder)
    kept = _measured_file(variant)
    if record and kept.is_file():
        measured = read_measured(kept)
        if measured.get("weights_sha256") == record.get("weights_sha256"):
            record |= measured
    return record


def own_record(variant: Variant, folder: Path | None = None) -> Mapping[str, Any]:
    """Return the training record of the expert that was trained on a variant; empty when there is none.

    ``folder`` is searched in place of :func:`policies_folder`, before the package's.

    Raises:
        PolicyError: if the record cannot be read.
    """
    path = find_policy_file(f"{variant}.json", folder)
    return {} if path is None else read_own_record(path, variant)


def readable_record(variant: Variant, folder: Path | None = None) -> Mapping[str, Any]:
    """Return what :func:`expert_record` returns. A record that cannot be read is left out with a warning."""
    try:
        return expert_record(variant, folder)
    except (PolicyError, PolicyNotFoundError) as error:
        warnings.warn(f"left out: {error}", PolicyWarning, stacklevel=2)
        return {}


def start_of(record: Mapping[str, Any]) -> str:
    """Return what an expert of its own started from, with the variant it was told if that is another one."""
    told = record.get("start_told") or record["variant"]
    return str(record["start"]) + ("" if told == record["variant"] else f" told {told}")


def is_folded(record: Mapping[str, Any]) -> bool:
    """Return whether a record is of a folded policy. The training of an own expert may start from one too."""
    return "universal_sha256" in record


def universal_policy(robot: str, folder: Path | None = None) -> UniversalPolicy | None:
    """Return the universal policy of a robot, or None when it has none.

    ``folder`` is searched in place of :func:`policies_folder`, before the package's.

    Raises:
        PolicyError: if its files are damaged.
    """
    path = find_policy_file(f"{universal_name(robot)}.safetensors", folder)
    if path is None:
        return None
    policy = read_universal(path)
    if policy.robot != robot:
        raise PolicyError(f"{path}: this is the universal policy of {policy.robot}, not of {robot}")
    return policy


def _folded_record(variant: Variant, folder: Path | None = None) -> dict[str, Any]:
    universal = universal_policy(variant.robot, folder)
    if universal is None or type(variant) is not Variant:
        return {}
    actor = universal.fold(variant)
    record: dict[str, Any] = {
        "variant": str(variant),
        "algorithm": actor.algorithm,
        "start": FOLDED,
        "universal_sha256": universal.sha256,
        "told": universal.told(variant),
        "weights_sha256": actor.sha256,
    }
    record |= universal.record["measured"].get(str(variant), {})
    return record


def keep_measured(variant: Variant, measured: Mapping[str, Any]) -> None:
    """Keep the evaluations of an expert, beside the user's policies, for :func:`expert_record`.

    Where they cannot be written, they are measured again the next time.
    """
    try:
        write_json(_measured_file(variant), dict(measured))
    except StorageError as error:
        warnings.warn(f"the evaluation of {variant} is not kept: {error}", PolicyWarning, stacklevel=2)


def _measured_file(variant: Variant) -> Path:
    return policies_folder().parent / "measured" / f"{variant}.json"


def expert_variants(folder: Path | None = None) -> tuple[Variant, ...]:
    """Return the variants that have an expert of their own, of the user or of the package, sorted.

    ``folder`` is searched in place of :func:`policies_folder`.
    """
    found = []
    for name in policy_files("*-*.json", folder):
        # The user may have policies of robots whose pages are not loaded now.
        with suppress(VariantError):
            found.append(Variant.parse(name.removesuffix(".json")))
    return tuple(sorted(found))


def agent_file(name: Variant | str, folder: Path | None = None) -> Path | None:
    """Return the file of an agent (actor, critics, optimiser) that training can start from, or None.

    ``name`` is a base, or ``<robot>-universal`` for the critics of the universal policy.
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


def policy_files(pattern: str, folder: Path | None = None) -> set[str]:
    """Return the names of the files in ``folder`` and in the package that fit a pattern."""
    return {path.name for place in _places(folder) if place.is_dir() for path in place.glob(pattern)}


def find_policy_file(name: str, folder: Path | None = None) -> Path | None:
    """Return the path of a file in ``folder`` (or :func:`policies_folder`) or in the package, or None.

    Raises:
        PolicyError: if something else has this name, for example a folder or a named pipe.
    """
    for place in _places(folder):
        path = place / name
        if path.is_file():
            return path
        if os.path.lexists(path):
            raise PolicyError(f"{path} is not a regular file")
    return None
