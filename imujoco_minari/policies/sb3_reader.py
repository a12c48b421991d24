"""Reads the actor in a Stable-Baselines3 zip. Imports torch: only a child process imports this module.

A zip holds ``policy.pth``, a file of ``torch.save``, and ``data``, a JSON text. Values that are no JSON
are pickles in base64 there, with a few fields as plain text beside each. The pickles are not read.
"""

from __future__ import annotations

import json
import pickle
import re
import zipfile
from collections.abc import Mapping
from io import BytesIO
from typing import Any

import torch
from safetensors.numpy import save

from imujoco_minari.errors import PolicyError, clipped

# The zip of SAC's default policy holds 3 MB of weights, of which the actor has 0.3 MB, and 20 kB of data.
MAX_DATA_BYTES = 2**24
MAX_WEIGHTS_BYTES = 2**28
MAX_ACTOR_BYTES = 2**26

_ALGORITHMS = {"stable_baselines3.sac.policies": "SAC", "sb3_contrib.tqc.policies": "TQC"}
_BOXES = ("<class 'gymnasium.spaces.box.Box'>", "<class 'gym.spaces.box.Box'>")
_FLATTEN = "<class 'stable_baselines3.common.torch_layers.FlattenExtractor'>"
_ACTIVATION = re.compile(r"<class 'torch\.nn\.modules\.activation\.(\w+)'>")
_GLOBAL = re.compile(r"GLOBAL (\S+) (?:was|whose)")

Settings = Mapping[str, Any]


def read_zip(path: str) -> bytes:
    """Return the actor of a zip: a line of JSON, then its weights as safetensors.

    The JSON object states ``algorithm`` and ``activation``. If the zip is refused, it states ``refused``
    (the reason), and no weights follow.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            settings = json.loads(_entry(archive, "data", MAX_DATA_BYTES))
            if not isinstance(settings, dict):
                raise PolicyError("its data is no JSON object")
            stated = {"algorithm": _algorithm(settings), "activation": _activation(settings)}
            _check_spaces(settings)
            weights = actor_weights(_entry(archive, "policy.pth", MAX_WEIGHTS_BYTES))
        return json.dumps(stated).encode() + b"\n" + save(weights)
    except PolicyError as error:
        reason = str(error)
    except MemoryError:
        raise
    except Exception as error:
        if "can't allocate memory" in str(error):
            raise MemoryError from None
        # zipfile, json and torch raise almost anything for a damaged file.
        reason = f"it is damaged ({type(error).__name__}: {str(error).partition(chr(10))[0][:120]})"
    return json.dumps({"refused": reason}).encode() + b"\n"


def actor_weights(raw: bytes) -> dict[str, Any]:
    """Return the actor's weights, float32, in a file of ``torch.save`` that holds a policy's state dict.

    Raises:
        PolicyError: if the file holds anything but weights, or no squashed Gaussian actor.
    """
    try:
        state = torch.load(BytesIO(raw), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        # torch's own message recommends to load the file without the check.
        named = _GLOBAL.search(str(error))
        what = f"names {clipped(ascii(named[1]))}" if named else "holds more than weights, or is damaged"
        raise PolicyError(f"the pickle in policy.pth {what}: refused") from None
    if not isinstance(state, dict):
        raise PolicyError("policy.pth holds no state dict")
    actor = {
        key.removeprefix("actor."): value
        for key, value in state.items()
        if isinstance(key, str) and key.startswith("actor.")
    }
    if "mu.weight" not in actor:
        raise PolicyError("it holds no squashed Gaussian actor; valid: a zip of SAC or TQC with MlpPolicy")
    for name, value in actor.items():
        if not isinstance(value, torch.Tensor) or not value.is_floating_point():
            raise PolicyError(f"{clipped(ascii(name))} is no tensor of floats")
    # Several tensors can share one storage, and an expanded tensor repeats it.
    size = sum(4 * value.numel() for value in actor.values())
    if size > MAX_ACTOR_BYTES:
        raise PolicyError(f"its actor has {size} bytes; the limit is {MAX_ACTOR_BYTES}")
    return {name: value.detach().float().numpy().copy() for name, value in actor.items()}


def _entry(archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    try:
        info = archive.getinfo(name)
    except KeyError:
        raise PolicyError(f"it has no entry {name}") from None
    if info.file_size > limit:
        raise PolicyError(f"{name} would unpack to {info.file_size} bytes; the limit is {limit}")
    return archive.read(info)


def _algorithm(settings: Settings) -> str:
    """Return the algorithm whose policy class the zip states. Another class may compute anything else."""
    module = _part(settings, "policy_class").get("__module__")
    if module not in _ALGORITHMS:
        raise PolicyError(
            f"its policy class is of {clipped(ascii(module))}; valid: MlpPolicy of {' or '.join(_ALGORITHMS)}"
        )
    return _ALGORITHMS[module]


def _activation(settings: Settings) -> str:
    """Return the activation's class name, after a check of all that changes what the actor computes."""
    arguments = _part(settings, "policy_kwargs")
    if settings.get("use_sde") or arguments.get("use_sde"):
        raise PolicyError(
            "its policy explores by gSDE, whose actor is not SAC's default; valid: trained without use_sde"
        )
    extractor = arguments.get("features_extractor_class", _FLATTEN)
    if extractor != _FLATTEN:
        raise PolicyError(f"its features extractor is {clipped(ascii(extractor))}; valid: FlattenExtractor")
    if "activation_fn" not in arguments:
        return "ReLU"
    named = _ACTIVATION.fullmatch(str(arguments["activation_fn"]))
    if named is None:
        raise PolicyError(
            f"its activation is {clipped(ascii(arguments['activation_fn']))}; valid: a class of torch.nn"
        )
    return named[1]


def _check_spaces(settings: Settings) -> None:
    """Raise a PolicyError unless observations are a vector and actions lie in [-1, 1]."""
    observations, actions = _part(settings, "observation_space"), _part(settings, "action_space")
    for name, space in (("observation", observations), ("action", actions)):
        if space.get(":type:") not in _BOXES:
            raise PolicyError(f"its {name} space is {clipped(ascii(space.get(':type:')))}; valid: a Box")
    shape = observations.get("_shape")
    if isinstance(shape, list) and len(shape) != 1:
        raise PolicyError(f"its observations have {len(shape)} dimensions; valid: 1")
    bounds = [str(actions.get(name)) for name in ("low", "high")]
    if [_numbers(text) for text in bounds] != [{-1.0}, {1.0}]:
        low, high = (clipped(ascii(text)) for text in bounds)
        raise PolicyError(f"its actions lie between {low} and {high}; valid: between -1 and 1")


def _numbers(text: str) -> set[float]:
    """Return the numbers in the text of an array; the empty set when there is anything else in it."""
    try:
        return {float(word) for word in text.replace("[", " ").replace("]", " ").split()}
    except ValueError:
        return set()


def _part(settings: Settings, name: str) -> Settings:
    value = settings.get(name)
    if not isinstance(value, dict):
        raise PolicyError(f"its data states no {name}")
    return value
