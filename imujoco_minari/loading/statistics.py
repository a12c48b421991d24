"""Mean and standard deviation of observations, to normalise them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.short_repr import short_repr

Array = NDArray[Any]

# Rows that are processed together. It bounds the size of temporary copies.
_BLOCK = 4096


@dataclass(frozen=True, eq=False)
class Statistics:
    """Mean and standard deviation of observations.

    Attributes:
        mean: (obs,) float64.
        std: (obs,) float64; 1 for an observation that is constant.
    """

    mean: Array
    std: Array

    __repr__ = short_repr

    def normalize(self, observations: Array) -> Array:
        """Return ``(observations - mean) / std`` in the dtype of ``observations``, or float64."""
        return ((observations - self.mean) / self.std).astype(normalized_dtype(observations), copy=False)

    def denormalize(self, observations: Array) -> Array:
        """Return ``observations * std + mean`` in the dtype of ``observations``, or float64."""
        return (observations * self.std + self.mean).astype(normalized_dtype(observations), copy=False)

    def normalize_in_place(self, observations: Array) -> None:
        """Normalise an array of floating-point observations (N, obs) without a copy of the whole array."""
        for block in _blocks(observations):
            block[...] = self.normalize(block)

    def tolist(self) -> list[list[float]]:
        """Return mean and standard deviation as lists, for JSON."""
        return [self.mean.tolist(), self.std.tolist()]


def measure(observations: Array) -> Statistics:
    """Return the statistics of observations (N, obs)."""
    mean = observations.mean(axis=0, dtype=np.float64)
    total = np.zeros_like(mean)
    for block in _blocks(observations):
        total += np.square(block - mean).sum(axis=0)
    std = np.sqrt(total / len(observations))
    return Statistics(mean, np.where(std > 0, std, 1.0))


def normalized_dtype(observations: Array) -> np.dtype[Any]:
    """Return the dtype of normalised observations: integers cannot hold them."""
    return observations.dtype if observations.dtype.kind == "f" else np.dtype(np.float64)


def _blocks(array: Array) -> Iterator[Array]:
    return (array[start : start + _BLOCK] for start in range(0, len(array), _BLOCK))
