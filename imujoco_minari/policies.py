"""Policies: a random one, the shipped actors, and actors out of Stable-Baselines3 zips.

An :class:`Actor` is SAC's squashed Gaussian (the shape TQC and other kin share). It acts in NumPy, a
tenth of the time of ``SAC.predict``, and its deterministic action equals ``SAC.predict``'s within
float32 rounding. A zip from outside is read without running anything that it contains.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import resources
from math import prod
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import PolicyError, PolicyNotFoundError
from imujoco_minari.torch_file import TorchFile, read_entry
from imujoco_minari.variants import EXPERT, Variant

Array = NDArray[Any]

# Observation and action sizes of the robots' v5 environments.
SIZES = {"hopper": (11, 3), "halfcheetah": (17, 6), "walker2d": (17, 6)}
# A default SAC zip holds 3 MB; anything near this is no policy of these robots.
MAX_ZIP_ENTRY, MAX_POLICY_FILE = 64 * 2**20, 256 * 2**20

_LOG_STD_RANGE = (-20.0, 2.0)
# What zipfile and json raise of a broken file.
_BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, RuntimeError)
_ACTIVATIONS = ("ReLU", "Tanh", "ELU", "SiLU")


# OpenBLAS shares a matrix-vector product among threads above 9216 elements, and the last bits of the
# sum then depend on their number, that is on the machine and on how many processes share it.
_BLOCK = 8192
# As an array: NumPy takes half a microsecond to convert the same number at each call.
_ZERO = np.zeros((), np.float32)


# How many observations an actor takes at once: at 8 the weights' way through the cache is shared by enough.
LANES = 8


class _Layer(NamedTuple):
    """An affine layer: its weight (in, out), a large one's blocks (block, in, out / blocks), its bias."""

    weight: Array
    blocks: Array | None
    bias: Array


class Policy(Protocol):
    """What chooses actions, and what a dataset records of it."""

    @property
    def algorithm(self) -> str:
        """Name of the algorithm that made the policy, as in ``TQC`` or ``random``."""

    @property
    def sha256(self) -> str:
        """Digest of all that decides its actions."""

    @property
    def deterministic(self) -> bool:
        """Whether the same observation always gives the same action."""

    def act(self, observation: Array, rng: np.random.Generator) -> Array:
        """Return the action (float32) for one observation (float64)."""


@dataclass(frozen=True)
class RandomPolicy:
    """Actions drawn uniformly from ``[-1, 1]``, the action space of all three robots."""

    action_size: int
    algorithm: str = "random"
    deterministic: bool = False

    @property
    def sha256(self) -> str:
        """Digest of its name: a random policy has no weights."""
        return hashlib.sha256(b"uniform [-1, 1]").hexdigest()

    def act(self, observation: Array, rng: np.random.Generator) -> Array:
        """Return a uniformly random action."""
        return rng.uniform(-1.0, 1.0, self.action_size).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Actor:
    """SAC's squashed Gaussian actor: a multilayer perceptron, then mean and log deviation.

    Attributes:
        weights: Stable-Baselines3's names (``latent_pi.0.weight`` ... ``mu.weight``, ``log_std.bias``)
            to float32 arrays, weights of shape (out, in).
        algorithm: name of the algorithm that trained it.
        deterministic: whether it acts by its mode or by a sample.
        activation: the hidden layers' activation, a torch class name.
        record: how it was trained and what it scores, for shipped weights.
    """

    weights: Mapping[str, Array]
    algorithm: str = "SAC"
    deterministic: bool = True
    activation: str = "ReLU"
    record: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_shapes(self.weights)
        if self.activation not in _ACTIVATIONS:
            raise PolicyError(
                f"activation {self.activation!r} is not supported; valid: {', '.join(_ACTIVATIONS)}"
            )

    @property
    def observation_size(self) -> int:
        """Length of the observation it takes."""
        return int(self.weights["latent_pi.0.weight"].shape[1])

    @property
    def action_size(self) -> int:
        """Length of the action it gives."""
        return int(self.weights["mu.bias"].shape[0])

    @cached_property
    def sha256(self) -> str:
        """Digest of the weights (names, shapes, float32 bytes) and the activation."""
        digest = hashlib.sha256(self.activation.encode())
        for name in sorted(self.weights):
            array = np.ascontiguousarray(self.weights[name], dtype="<f4")
            digest.update(f"{name}{array.shape}".encode())
            digest.update(array.tobytes())
        return digest.hexdigest()

    def act(self, observation: Array, rng: np.random.Generator) -> Array:
        """Return the action for an observation of shape ``(n,)`` or a batch ``(b, n)``.

        A row of a batch differs from the same observation alone by float32 rounding.
        """
        latent = observation.astype(np.float32)
        for layer in self._hidden:
            latent = self._activate(_affine(latent, layer))
        mean = _affine(latent, self._mean)
        if not self.deterministic:
            log_std = np.clip(_affine(latent, self._log_std), *_LOG_STD_RANGE)
            mean = mean + np.exp(log_std) * rng.standard_normal(mean.shape, dtype=np.float32)
        action: Array = np.tanh(mean)
        return action

    def act_together(self, observations: Array, rngs: Sequence[np.random.Generator]) -> Array:
        """Return the actions (b, action) for up to ``LANES`` observations (b, n), each with its own draws.

        Each is to the bit the same whatever the others are, and however many; it differs from
        :meth:`act`'s by float32 rounding. Costs 3 us an observation, where :meth:`act` costs 10.
        """
        latent = np.zeros((LANES, self.observation_size), np.float32)
        latent[: len(observations)] = observations
        for layer in self._hidden:
            latent = self._activate(_affine_together(latent, layer))
        mean = _affine_together(latent, self._mean)
        if not self.deterministic:
            log_std = np.clip(_affine_together(latent, self._log_std), *_LOG_STD_RANGE)
            for row, rng in enumerate(rngs):
                mean[row] += np.exp(log_std[row]) * rng.standard_normal(mean.shape[1], dtype=np.float32)
        action: Array = np.tanh(mean[: len(observations)])
        return action

    def check(self, robot: str) -> None:
        """Raise a :class:`PolicyError` unless the actor fits ``robot``."""
        sizes = (self.observation_size, self.action_size)
        if sizes != SIZES[robot]:
            fits = [name for name, expected in SIZES.items() if expected == sizes]
            raise PolicyError(
                f"the policy maps {sizes[0]} observations to {sizes[1]} actions, but {robot} has "
                f"{SIZES[robot][0]} and {SIZES[robot][1]}"
                + (f"; it fits {' and '.join(fits)}" if fits else "")
            )

    @cached_property
    def _hidden(self) -> list[_Layer]:
        return [self._layer(f"latent_pi.{2 * i}") for i in range(_depth(self.weights))]

    @cached_property
    def _mean(self) -> _Layer:
        return self._layer("mu")

    @cached_property
    def _log_std(self) -> _Layer:
        return self._layer("log_std")

    def _layer(self, name: str) -> _Layer:
        weight = self.weights[f"{name}.weight"].astype(np.float32)
        size, inputs = weight.shape
        blocks = next(n for n in range(1, size + 1) if size % n == 0 and inputs * size // n <= _BLOCK)
        return _Layer(
            np.ascontiguousarray(weight.T),
            None
            if blocks == 1
            else np.ascontiguousarray(weight.reshape(blocks, size // blocks, inputs).transpose(0, 2, 1)),
            self.weights[f"{name}.bias"].astype(np.float32),
        )

    def _activate(self, x: Array) -> Array:
        if self.activation == "ReLU":
            return np.maximum(x, _ZERO, out=x)
        if self.activation == "Tanh":
            return np.asarray(np.tanh(x))
        if self.activation == "ELU":
            return np.where(x > 0, x, np.expm1(np.minimum(x, 0.0)))
        return np.asarray(x / (1.0 + np.exp(-x)))


def _affine(x: Array, layer: _Layer) -> Array:
    """Return the layer's output, for one observation to the bit the same whatever the number of threads."""
    weight, blocks, bias = layer
    y: Array
    if x.ndim > 1:
        y = x @ weight
    elif blocks is None:
        y = np.dot(x, weight)
    else:
        y = np.matmul(x, blocks).ravel()
    y += bias
    return y


def _affine_together(x: Array, layer: _Layer) -> Array:
    """Return the layer's output for ``LANES`` rows, which always makes the same products of the same sizes."""
    weight, blocks, bias = layer
    y: Array = np.dot(x, weight) if blocks is None else np.matmul(x, blocks).transpose(1, 0, 2)
    y = y.reshape(LANES, -1)
    y += bias
    return y


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
        return RandomPolicy(SIZES[variant.robot][1])
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
    return _actor_of(path.read_bytes(), path.name, record["algorithm"], deterministic, record)


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
    return tuple(sorted(Variant.parse(name.removesuffix(".json")) for name in names))


def expert_agent(variant: Variant, folder: Path | None = None) -> Path | None:
    """Return the file of the whole agent that variants of a base start from, or None."""
    return find_policy_file(f"{variant}.agent.safetensors", folder)


def policies_folder() -> Path:
    """Return the folder of the user's own policies: ``$IMUJOCO_HOME/policies``, or ``~/.imujoco/policies``."""
    home = os.environ.get("IMUJOCO_HOME")
    return (Path(home) if home else Path.home() / ".imujoco") / "policies"


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
        return _actor_of(path.read_bytes(), str(path), algorithm, deterministic, {})
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


def _actor_of(
    data: bytes, name: str, algorithm: str, deterministic: bool, record: Mapping[str, Any]
) -> Actor:
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


def _depth(weights: Mapping[str, Array]) -> int:
    return sum(name.startswith("latent_pi.") and name.endswith(".weight") for name in weights)


def _check_shapes(weights: Mapping[str, Array]) -> None:
    """Raise a :class:`PolicyError` unless the layers chain from observation to mean and deviation."""
    names = [f"latent_pi.{2 * i}" for i in range(_depth(weights))]
    if not names:
        raise PolicyError("the actor has no hidden layer")
    expected = {f"{name}.{part}" for name in (*names, "mu", "log_std") for part in ("weight", "bias")}
    if expected != set(weights):
        odd = sorted(expected ^ set(weights))[0]
        raise PolicyError(
            f"the actor is not SAC's: {odd} is {'missing' if odd in expected else 'unexpected'}"
        )
    width = None
    for name in names:
        width = _check_layer(weights, name, width)
    means, deviations = _check_layer(weights, "mu", width), _check_layer(weights, "log_std", width)
    if means != deviations:
        raise PolicyError(f"the actor gives {means} means but {deviations} deviations")


def _check_layer(weights: Mapping[str, Array], name: str, width: int | None) -> int:
    weight, bias = weights[f"{name}.weight"], weights[f"{name}.bias"]
    if weight.ndim != 2 or bias.shape != (weight.shape[0],) or 0 in weight.shape:
        raise PolicyError(f"{name}: weight {weight.shape} and bias {bias.shape} make no layer")
    if width is not None and weight.shape[1] != width:
        raise PolicyError(f"{name}: takes {weight.shape[1]} inputs, but the layer before gives {width}")
    if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
        raise PolicyError(f"{name}: weights are not finite")
    return int(weight.shape[0])


def _places(folder: Path | None) -> tuple[Path, Path]:
    """Return where policies are looked for, first choice first."""
    return (policies_folder() if folder is None else folder), Path(
        str(resources.files("imujoco_minari") / "weights")
    )


def find_policy_file(name: str, folder: Path | None = None) -> Path | None:
    """Return the file ``name`` among the user's policies (or in ``folder``), else among the shipped, or None."""
    return next((place / name for place in _places(folder) if (place / name).is_file()), None)


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]
