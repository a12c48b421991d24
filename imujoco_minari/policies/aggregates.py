"""Aggregates of scores: the interquartile mean, and its bootstrap interval."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imujoco_minari.errors import ArgumentError

RESAMPLES, CONFIDENCE = 2000, 0.95


def interquartile_mean(values: ArrayLike) -> float:
    """Return the mean of the values without the lowest and the highest quarter.

    Of n values, ``n // 4`` are left out on each side.

    Args:
        values: of any shape; all of them count alike.

    Raises:
        ArgumentError: when there are no values.

    Example:
        >>> interquartile_mean([0, 1, 2, 100])
        1.5
    """
    return float(_interquartile_means(_rows(values).reshape(1, -1))[0])


def bootstrap_interval(values: ArrayLike, *, seed: int = 0, tasks: bool = False) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval of the interquartile mean.

    Args:
        values: of shape (n,) or (n, tasks): n episodes or runs, of one or of several tasks. A run is drawn
            with the values of all its tasks, because they share what the run has learnt.
        seed: of the 2000 resamples.
        tasks: draw the tasks too, so that the interval is of other tasks of the same kind.

    Raises:
        ArgumentError: when there are no values.
    """
    rows = _rows(values)
    rng = np.random.default_rng(seed)
    count, width = rows.shape
    means = []
    for size in [100] * (RESAMPLES // 100):
        runs = rng.integers(count, size=(size, count))[:, :, None]
        columns = rng.integers(width, size=(size, 1, width)) if tasks else np.arange(width)
        means.append(_interquartile_means(rows[runs, columns].reshape(size, -1)))
    low, high = np.quantile(np.concatenate(means), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def _rows(values: ArrayLike) -> NDArray[Any]:
    array = np.asarray(values, dtype=np.float64)
    if not array.size:
        raise ArgumentError("there are no values to aggregate")
    return array.reshape(len(array), -1) if array.ndim else array.reshape(1, 1)


def _interquartile_means(samples: NDArray[Any]) -> NDArray[Any]:
    """Return the interquartile mean of each row."""
    cut = samples.shape[1] // 4
    means: NDArray[Any] = np.sort(samples, axis=1)[:, cut : samples.shape[1] - cut].mean(axis=1)
    return means
