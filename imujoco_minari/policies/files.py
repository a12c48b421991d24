"""Actors out of files: safetensors, and Stable-Baselines3 zips, read without running what they hold."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.errors import PolicyError, PolicyNotFoundError
from imujoco_minari.policies.actors import Actor
from imujoco_minari.policies.torch_file import TorchFile, read_entry

# A default SAC zip holds 3 MB; anything near this is no policy of these robots.
MAX_ZIP_ENTRY, MAX_POLICY_FILE = 64 * 2**20, 256 * 2**20

# What zipfile and json raise of a broken file.
_BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, RuntimeError)


def read_actor(path: Path, *, deterministic: bool = True, algorithm: str = "SAC") -> Actor:
    """Read an actor from a Stable-Baselines3 ``.zip`` or a ``.safetensors`` file.

    Args:
        path: the file.
        deterministic: whether the actor acts by its mode.
        algorithm: what trained the actor of a ``.safetensors``, which does not say so itself.

    Raises:
        PolicyNotFoundError: when there is no such file.
        PolicyError: when it is neither, or holds no squashed Gaussian actor.
    """
    if not path.is_file():
        raise PolicyNotFoundError(f"no policy file at {path}")
    if path.stat().st_size > MAX_POLICY_FILE:
        raise PolicyError(f"{path} has {path.stat().st_size} bytes; the limit is {MAX_POLICY_FILE}")
    if path.suffix == ".safetensors":
        return actor_of_bytes(path.read_bytes(), str(path), algorithm, deterministic, {})
    if not _is_zip(path):
        raise PolicyError(
            f"{path} is no policy; valid: a Stable-Baselines3 SAC .zip, or an actor's .safetensors"
        )
    return _read_zip(path, deterministic)


def _is_zip(path: Path) -> bool:
    try:
        return zipfile.is_zipfile(path)
    except zipfile.BadZipFile:
        # Raised of some that nearly are.
        return False


def actor_of_bytes(
    data: bytes, name: str, algorithm: str, deterministic: bool, record: Mapping[str, Any]
) -> Actor:
    """Return the actor in the bytes of a ``.safetensors`` file called ``name``.

    Raises:
        PolicyError: when they hold none.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        weights = {key: array.astype(np.float32) for key, array in load(data).items()}
        return Actor(weights, algorithm, deterministic, record=record)
    except (SafetensorError, PolicyError, KeyError, TypeError, ValueError) as error:
        raise PolicyError(f"{name}: holds no actor: {error}") from None


def _read_zip(path: Path, deterministic: bool) -> Actor:
    """Read the actor out of a Stable-Baselines3 zip, of version 1 or 2.

    Of ``data``, whose values are pickles, only the plain JSON text beside them is looked at.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            state = TorchFile(io.BytesIO(read_entry(archive, "policy.pth", MAX_ZIP_ENTRY)))
            settings = json.loads(read_entry(archive, "data", MAX_ZIP_ENTRY))
        if not isinstance(settings, dict):
            raise PolicyError("its data is no JSON object")
        if settings.get("use_sde"):
            raise PolicyError(
                "the policy explores by gSDE, whose actor is not SAC's default; train without use_sde"
            )
        if "actor.mu.weight" not in state.tensors:
            raise PolicyError("holds no squashed Gaussian actor; valid: a zip of SAC or TQC with MlpPolicy")
        weights = {
            key.removeprefix("actor."): state.read(key).astype(np.float32)
            for key in state.tensors
            if key.startswith("actor.")
        }
        return Actor(
            weights,
            algorithm=_algorithm(state),
            deterministic=deterministic,
            activation=_activation(settings),
        )
    except (PolicyError, *_BROKEN) as error:
        raise PolicyError(
            f"{path}: not a readable Stable-Baselines3 zip of a policy: {_first_line(error)}"
        ) from None


def _activation(settings: dict[str, Any]) -> str:
    """Return the activation's class name from the JSON text of ``policy_kwargs``; SAC's default is ReLU."""
    arguments = settings.get("policy_kwargs")
    named = arguments.get("activation_fn") if isinstance(arguments, dict) else None
    if named is None:
        return "ReLU"
    return str(named).rstrip("'>").rpartition(".")[2][:40]


def _algorithm(state: TorchFile) -> str:
    """Name the algorithm by its critic: TQC's gives many quantiles where SAC's gives one value."""
    biases = [
        tensor.shape
        for key, tensor in state.tensors.items()
        if key.startswith("critic.qf0.") and key.endswith(".bias")
    ]
    return "TQC" if biases and prod(biases[-1]) > 1 else "SAC"


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]
