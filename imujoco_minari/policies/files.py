"""Reads actors from safetensors and from Stable-Baselines3 zips. Nothing in a file is run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.errors import JobError, PolicyError, PolicyNotFoundError
from imujoco_minari.limits import run_limited
from imujoco_minari.policies.actors import Actor

# The zip of SAC's default policy has 3 MB, its actor 0.3 MB.
_MAX_ZIP_BYTES, _MAX_SAFETENSORS_BYTES = 2**28, 2**26
# Memory and processor time for reading a zip; one of the largest size needs less.
MAX_MEMORY_BYTES, MAX_SECONDS = 2**30, 5

_ZIP_MAGIC = b"PK\3\4"


def read_actor(path: str | Path, *, deterministic: bool = True, algorithm: str = "SAC") -> Actor:
    """Read an actor from a Stable-Baselines3 ``.zip`` or a ``.safetensors`` file.

    A zip is read by a child process with limits on memory and time, because a few hundred bytes can ask
    torch for any amount of either. The child imports torch, which takes a second or two; this process
    does not. A zip is refused unless the actor computes what Stable-Baselines3 does: an ``MlpPolicy`` of
    SAC or TQC, with the default features extractor, without gSDE, for actions in ``[-1, 1]``. A zip
    does not hold the statistics of ``VecNormalize``: a policy that was trained with them acts wrongly.

    Args:
        path: the file.
        deterministic: whether the actor takes the mode of its distribution, or a sample.
        algorithm: name of the algorithm that trained the actor of a ``.safetensors``. A zip states it.

    Raises:
        PolicyNotFoundError: if the file does not exist.
        PolicyError: if the file holds no actor that this package can represent.

    Examples:
        >>> actor = read_actor("model.zip")  # doctest: +SKIP
        >>> actor.act(observation, np.random.default_rng(0))  # doctest: +SKIP
    """
    if not isinstance(path, str | Path):
        raise PolicyError(f"a policy file is named by a str or a Path, not by {type(path).__name__}")
    path = Path(path)
    if not path.is_file():
        raise PolicyNotFoundError(f"no policy file at {path}")
    is_safetensors = path.suffix == ".safetensors"
    limit = _MAX_SAFETENSORS_BYTES if is_safetensors else _MAX_ZIP_BYTES
    if (size := path.stat().st_size) > limit:
        raise PolicyError(f"{path} has {size} bytes; the limit is {limit}")
    if is_safetensors:
        try:
            return Actor(_weights(path.read_bytes()), algorithm, deterministic)
        except PolicyError as error:
            raise PolicyError(f"{path}: holds no actor: {error}") from None
    with path.open("rb") as file:
        if file.read(len(_ZIP_MAGIC)) != _ZIP_MAGIC:
            raise PolicyError(
                f"{path} is no policy; valid: a Stable-Baselines3 SAC .zip, or an actor's .safetensors"
            )
    return _read_zip(path, deterministic)


def _weights(data: bytes) -> dict[str, Any]:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        return {key: array.astype(np.float32) for key, array in load(data).items()}
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise PolicyError(str(error)) from None


def _read_zip(path: Path, deterministic: bool) -> Actor:
    try:
        answer = run_limited(
            "imujoco_minari.policies.sb3_reader:read_zip",
            str(path.absolute()),
            memory=MAX_MEMORY_BYTES,
            seconds=MAX_SECONDS,
        )
        line, _, weights = answer.partition(b"\n")
        stated = json.loads(line)
        if "refused" in stated:
            raise PolicyError(stated["refused"])
        return Actor(_weights(weights), stated["algorithm"], deterministic, activation=stated["activation"])
    except JobError as error:
        raise PolicyError(f"{path}: cannot be read as a policy: reading it {error}") from None
    except PolicyError as error:
        raise PolicyError(f"{path}: cannot be read as a policy: {error}") from None
