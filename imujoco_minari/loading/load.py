"""Load datasets as contiguous arrays with one row for each step.

The arrays are allocated once and filled in place, so that loading needs little more memory than the result.
This module requires only h5py and NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from imujoco_minari.errors import ArgumentError, DatasetError, check_one_robot, clipped
from imujoco_minari.loading import selection
from imujoco_minari.loading.episode_arrays import Arrays
from imujoco_minari.loading.selection import Datasets, EpisodeReference
from imujoco_minari.loading.statistics import Statistics, measure, normalized_dtype
from imujoco_minari.storage.reader import EpisodeFile

Array = NDArray[Any]


def arrays(
    datasets: Datasets,
    *,
    where: Mapping[str, Any] | None = None,
    portion: tuple[float, float] = (0.0, 1.0),
    seed: int = 0,
    dtype: DTypeLike | None = None,
    normalize: bool | Statistics = False,
) -> Arrays:
    """Load datasets of one robot as contiguous arrays.

    Args:
        datasets: a Minari dataset or its id, or a list of them. Collections and filtered views are valid.
        where: keep only episodes with these attributes, as in
            ``{"category": "mass", "percent": [-50, -25]}``. The keys are variant, robot, category, body,
            percent, tier and changes.
        portion: keep this share of each variant's and tier's episodes, after a shuffle by ``seed``:
            (0, 0.75) to train, (0.75, 1) to test.
        seed: of that shuffle.
        dtype: of observations and rewards, ``"float32"`` for most learners; None keeps the stored dtype.
        normalize: shift and scale the observations, by their own statistics (True) or by the given ones
            (the statistics of the training share, for the test share).

    Returns:
        The arrays, with the episodes in the order of ``datasets``.

    Raises:
        DatasetNotFoundError: when a dataset is not in the Minari root.
        VariantError: when ``where`` has an unknown attribute, or a value that no episode has.
        DatasetError: when the datasets are of several robots, or a dataset is not valid.
        ArgumentError: when an argument is not valid.

    Example:
        >>> train = arrays("imujoco/hopper-base-v0", portion=(0.0, 0.75), dtype="float32")  # doctest: +SKIP
        >>> train.observations.shape  # doctest: +SKIP
        (75000, 11)
    """
    if not isinstance(normalize, bool | Statistics):
        raise ArgumentError(f"normalize must be True, False or Statistics, not {clipped(repr(normalize))}")
    dtype = None if dtype is None else _floating(dtype)
    with ExitStack() as stack:
        views = selection.views(datasets)
        files = {
            view: stack.enter_context(EpisodeFile(view.file, view.dataset_id))
            for view in dict.fromkeys(views)
        }
        found = [episode for view in views for episode in selection.episodes(view, files[view])]
        if not found:
            raise DatasetError("the datasets hold no episodes")
        kept = selection.matching(found, {} if where is None else where)
        check_one_robot(((each.origin.robot, each.file.name) for each in kept), "arrays hold")
        share = selection.portion_of([episode.origin for episode in kept], portion, seed)
        result = _fill([kept[place] for place in share], dtype)
    if normalize is False:
        return result
    statistics = measure(result.observations) if normalize is True else normalize
    shape = result.observations.shape[1:]
    if statistics.mean.shape != shape:
        raise DatasetError(f"statistics of {statistics.mean.shape} do not fit observations of {shape}")
    kind = normalized_dtype(result.observations)
    observations = result.observations.astype(kind, copy=False)
    next_observations = result.next_observations.astype(kind, copy=False)
    statistics.normalize_in_place(observations)
    statistics.normalize_in_place(next_observations)
    return replace(
        result, observations=observations, next_observations=next_observations, statistics=statistics
    )


def _floating(dtype: DTypeLike) -> np.dtype[Any]:
    try:
        found = np.dtype(dtype)
    except TypeError:
        found = None
    if found is None or found.kind != "f":
        raise ArgumentError(
            f"dtype must be a floating-point type, as in 'float32', not {clipped(repr(dtype))}"
        )
    return found


def _fill(kept: Sequence[EpisodeReference], dtype: DTypeLike | None) -> Arrays:
    """Allocate the arrays of all kept episodes, and read each episode into its rows."""
    lengths = np.array([each.file.length(each.number) for each in kept], dtype=np.int64)
    if not lengths.all():
        raise DatasetError(f"{kept[int(lengths.argmin())].file.name} holds an episode without steps")
    ends = np.cumsum(lengths)
    starts = ends - lengths
    first = kept[0].file
    layouts = {name: first.layout(kept[0].number, name) for name in ("observations", "actions", "rewards")}
    for (name, (shape, stored)), dimensions in zip(layouts.items(), (2, 2, 1), strict=True):
        if len(shape) != dimensions or stored.kind not in "fiu":
            raise DatasetError(
                f"{first.name}: {name} must be {'vectors of ' * (dimensions - 1)}numbers at each step, "
                f"not {stored} of shape {shape[1:]}"
            )

    def empty(name: str, kind: DTypeLike | None = None, rows: int = int(ends[-1])) -> Array:
        (_, *shape), stored = layouts[name]
        return np.empty((rows, *shape), kind or stored)

    steps, longest = int(ends[-1]), int(lengths.max())
    observations, actions, rewards = empty("observations", dtype), empty("actions"), empty("rewards", dtype)
    next_observations = np.empty_like(observations)
    terminations, truncations = np.empty(steps, bool), np.empty(steps, bool)
    table = tuple(dict.fromkeys(episode.origin for episode in kept))
    places = {origin: place for place, origin in enumerate(table)}
    # HDF5 reads the stored dtype, and NumPy splits and converts: NumPy is faster at both.
    scratch, scratch_rewards = empty("observations", rows=longest + 1), empty("rewards", rows=longest)
    for episode, start, end in zip(kept, starts.tolist(), ends.tolist(), strict=True):
        both, earned = scratch[: end - start + 1], scratch_rewards[: end - start]
        episode.file.read(
            episode.number,
            {
                "observations": both,
                "actions": actions[start:end],
                "rewards": earned,
                "terminations": terminations[start:end],
                "truncations": truncations[start:end],
            },
        )
        observations[start:end], next_observations[start:end] = both[:-1], both[1:]
        rewards[start:end] = earned
    return Arrays(
        observations,
        actions,
        rewards,
        next_observations,
        terminations,
        truncations,
        np.repeat(np.array([places[episode.origin] for episode in kept], np.int32), lengths),
        starts,
        table,
    )
