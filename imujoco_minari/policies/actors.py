"""SAC's squashed Gaussian actor in NumPy.

The actor takes a tenth of the time of ``SAC.predict``. Its deterministic action equals that of
``SAC.predict`` within float32 rounding.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from imujoco_minari.errors import PolicyError, clipped
from imujoco_minari.policies.doors import Array, Doors, given
from imujoco_minari.variants import known_robots, specification

LOG_STD_RANGE = (-20.0, 2.0)
_ACTIVATIONS = ("ReLU", "Tanh", "ELU", "SiLU")

# OpenBLAS uses several threads for a matrix-vector product of more than 9216 elements. The last bits of
# the sum then depend on the number of threads, so on the machine and on its load.
_BLOCK = 8192
# An array, because NumPy takes half a microsecond to convert a Python number at each call.
_ZERO = np.zeros((), np.float32)

# Number of observations that act_together() takes at once. At 16, loading the weights no longer dominates.
LANES = 16
# Rows of one matrix product. With more, OpenBLAS's kernels for AVX2 round a row by its place.
_ROWS = 8


class _Layer(NamedTuple):
    """An affine layer: weight (in, out), and that of a large layer in blocks (blocks, in, out / blocks)."""

    weight: Array
    blocks: Array | None
    bias: Array


class Policy(Protocol):
    """Chooses an action for each observation."""

    @property
    def algorithm(self) -> str:
        """Name of the algorithm that made the policy, for example ``CrossQ`` or ``random``."""

    @property
    def sha256(self) -> str:
        """Digest of everything that decides the actions."""

    @property
    def deterministic(self) -> bool:
        """Whether the same observation always gives the same action."""

    def act(self, observation: Array, rng: np.random.Generator) -> Array:
        """Return the action (float32) for one observation (float64)."""


@dataclass(frozen=True, eq=False, repr=False)
class Actor(Doors):
    """SAC's squashed Gaussian actor: a multilayer perceptron with two heads, mean and log deviation.

    Attributes:
        weights: float32 arrays by Stable-Baselines3's names (``latent_pi.0.weight`` ... ``mu.weight``,
            ``log_std.bias``). A weight has the shape (out, in), a bias (out,).
        algorithm: name of the algorithm that trained the actor.
        deterministic: whether the actor takes the mode of its distribution, or a sample.
        activation: class name in ``torch.nn`` of the hidden layers' activation: ``ReLU``, ``Tanh``,
            ``ELU`` or ``SiLU``.
        record: the training record of an expert, with its evaluation; else empty.
        bound: largest absolute value of an action's entry. The squashed Gaussian is scaled by it.

    Raises:
        PolicyError: if the arrays are not the weights of such an actor.
    """

    weights: Mapping[str, Array]
    algorithm: str = "SAC"
    deterministic: bool = True
    activation: str = "ReLU"
    record: Mapping[str, Any] = field(default_factory=dict)
    bound: float = 1.0

    def __post_init__(self) -> None:
        _check_shapes(self.weights)
        if self.activation not in _ACTIVATIONS:
            raise PolicyError(
                f"activation {self.activation!r} is not supported; valid: {', '.join(_ACTIVATIONS)}"
            )

    def __repr__(self) -> str:
        widths = [self.observation_size, *self.hidden_sizes, self.action_size]
        return (
            f"Actor({self.algorithm}, layers {'-'.join(map(str, widths))}, {self.activation}, "
            f"{'deterministic' if self.deterministic else 'stochastic'})"
        )

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return int(self.weights["latent_pi.0.weight"].shape[1])

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return int(self.weights["mu.bias"].shape[0])

    @property
    def hidden_sizes(self) -> list[int]:
        """Number of units in each hidden layer."""
        return [layer.bias.size for layer in self._layers[0]]

    @cached_property
    def sha256(self) -> str:
        """Digest of the weights (names, shapes, float32 bytes) and the activation."""
        digest = hashlib.sha256(self.activation.encode())
        for name in sorted(self.weights):
            array = np.ascontiguousarray(self.weights[name], dtype="<f4")
            digest.update(f"{name}{array.shape}".encode())
            digest.update(array.tobytes())
        return digest.hexdigest()

    def act(self, observation: Array, rng: np.random.Generator | None = None) -> Array:
        """Return the action, float32 in ``[-bound, bound]``, for an observation.

        The result for a row of a batch differs from the result for that row alone by float32 rounding.

        Args:
            observation: of shape ``(n,)``, or a batch of shape ``(b, n)``.
            rng: source of the sample; a deterministic actor does not use it.

        Raises:
            ArgumentError: when the observation has another length than the actor takes, or the actor samples
                and there is no ``rng``.
        """
        try:
            latent = self._latent(observation)
        except (ValueError, AttributeError):  # a check before each action would take 5 % of its time
            latent = self._latent(self._fitting(observation))
        _, means, deviations = self._layers
        mean = _affine(latent, means)
        if not self.deterministic:
            log_std = np.clip(_affine(latent, deviations), *LOG_STD_RANGE)
            mean = mean + np.exp(log_std) * given(rng).standard_normal(mean.shape, dtype=np.float32)
        return self._scale(np.tanh(mean))

    def distribution(self, observation: Array) -> tuple[Array, Array]:
        """Return mean and log deviation of the Gaussian before squashing, each of shape (..., action size).

        Args:
            observation: of shape ``(n,)``, or a batch of shape ``(b, n)``.
        """
        latent, (_, means, deviations) = self._latent(observation), self._layers
        return _affine(latent, means), np.clip(_affine(latent, deviations), *LOG_STD_RANGE)

    def _latent(self, observation: Array) -> Array:
        latent = observation.astype(np.float32)
        for layer in self._layers[0]:
            latent = self._activate(_affine(latent, layer))
        return latent

    def act_together(self, observations: Array, rngs: Sequence[np.random.Generator]) -> Array:
        """Return the actions, of shape (b, action size), for several observations.

        An action does not depend on the other observations or on their number, to the last bit. It
        differs from the result of :meth:`act` by float32 rounding. An observation takes 2.3 us here and
        10 us in :meth:`act`.

        Args:
            observations: of shape (b, n), with b at most ``LANES``.
            rngs: a source of samples for each observation; a deterministic actor does not use them.

        Raises:
            ArgumentError: when the observations have another length than the actor takes.
        """
        latent = np.zeros((LANES, self.observation_size), np.float32)
        latent[: len(observations)] = self._fitting(observations)
        hidden, means, deviations = self._layers
        for layer in hidden:
            latent = self._activate(_affine_together(latent, layer))
        mean = _affine_together(latent, means)
        if not self.deterministic:
            log_std = np.clip(_affine_together(latent, deviations), *LOG_STD_RANGE)
            for row, rng in enumerate(rngs):
                mean[row] += np.exp(log_std[row]) * rng.standard_normal(mean.shape[1], dtype=np.float32)
        return self._scale(np.tanh(mean[: len(observations)]))

    def _scale(self, action: Array) -> Array:
        return action if self.bound == 1.0 else action * np.float32(self.bound)

    def for_robot(self, robot: str) -> Actor:
        """Return the actor with the action bound of a robot.

        Raises:
            PolicyError: when it has not the observation and action size of the robot.
        """
        self.check(robot)
        bound = specification(robot).action_bound
        return self if bound == self.bound else replace(self, bound=bound)

    def check(self, robot: str) -> None:
        """Check that the actor has the observation and action size of a robot.

        Raises:
            PolicyError: if it has not.
        """
        sizes = (self.observation_size, self.action_size)
        expected = specification(robot).sizes
        if sizes != expected:
            fits = [name for name in known_robots() if specification(name).sizes == sizes]
            raise PolicyError(
                f"the policy maps {sizes[0]} observations to {sizes[1]} actions, but {robot} has "
                f"{expected[0]} and {expected[1]}" + (f"; it fits {' and '.join(fits)}" if fits else "")
            )

    @cached_property
    def _layers(self) -> tuple[list[_Layer], _Layer, _Layer]:
        """The hidden layers, the one of the means, and the one of the log deviations."""
        hidden = [self._layer(f"latent_pi.{2 * i}") for i in range(depth(self.weights))]
        return hidden, self._layer("mu"), self._layer("log_std")

    def _layer(self, name: str) -> _Layer:
        weight, bias = (self.weights[f"{name}.{part}"].astype(np.float32) for part in ("weight", "bias"))
        size, inputs = weight.shape
        count = next(n for n in range(1, size + 1) if size % n == 0 and inputs * size // n <= _BLOCK)
        blocks = None
        if count > 1:
            blocks = np.ascontiguousarray(weight.reshape(count, size // count, inputs).transpose(0, 2, 1))
        return _Layer(np.ascontiguousarray(weight.T), blocks, bias)

    def _activate(self, x: Array) -> Array:
        if self.activation == "ReLU":
            return np.maximum(x, _ZERO, out=x)
        if self.activation == "Tanh":
            return np.asarray(np.tanh(x))
        if self.activation == "ELU":
            return np.where(x > 0, x, np.expm1(np.minimum(x, 0.0)))
        return np.asarray(x / (1.0 + np.exp(-x)))


def _affine(x: Array, layer: _Layer) -> Array:
    """Return the layer's output. For one observation it does not depend on the number of threads."""
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
    """Return the layer's output for ``LANES`` rows, with products whose sizes are always the same."""
    weight, blocks, bias = layer
    groups = x.reshape(LANES // _ROWS, _ROWS, -1)
    y: Array = (
        np.matmul(groups, weight)
        if blocks is None
        else np.matmul(groups[:, None], blocks).transpose(0, 2, 1, 3)
    )
    y = y.reshape(LANES, -1)
    y += bias
    return y


def depth(weights: Mapping[str, Array]) -> int:
    """Return the number of an actor's hidden layers."""
    return sum(name.startswith("latent_pi.") and name.endswith(".weight") for name in weights)


def _check_shapes(weights: Mapping[str, Array]) -> None:
    """Raise a :class:`PolicyError` unless the layers chain from observation to mean and deviation."""
    names = [f"latent_pi.{2 * i}" for i in range(depth(weights))]
    if not names:
        raise PolicyError("the actor has no hidden layer")
    expected = {f"{name}.{part}" for name in (*names, "mu", "log_std") for part in ("weight", "bias")}
    if expected != set(weights):
        odd = sorted(expected ^ set(weights))[0]
        raise PolicyError(
            f"the actor is not SAC's: {clipped(ascii(odd))} is "
            f"{'missing' if odd in expected else 'unexpected'}"
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
        raise PolicyError(f"{name}: weight {weight.shape} and bias {bias.shape} are no layer")
    if width is not None and weight.shape[1] != width:
        raise PolicyError(f"{name}: takes {weight.shape[1]} inputs, but the layer before gives {width}")
    if weight.shape[1] > _BLOCK:
        raise PolicyError(f"{name}: takes {weight.shape[1]} inputs; the limit is {_BLOCK}")
    if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
        raise PolicyError(f"{name}: weights are not finite")
    return int(weight.shape[0])
