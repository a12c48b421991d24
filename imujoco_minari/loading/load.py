"""Datasets as contiguous arrays: one row a step, whatever datasets, variants and tiers they come from.

The arrays are allocated once and filled in place, so a load needs little more memory than its result;
with a cache, later loads map files and take milliseconds. Needs h5py and NumPy only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from imujoco_minari.errors import DatasetError
from imujoco_minari.loading import array_cache, selection
from imujoco_minari.loading.selection import Origin
from imujoco_minari.storage.reader import EpisodeFile

if TYPE_CHECKING:
    from imujoco_minari.loading.selection import Datasets, Episode

Array = NDArray[Any]


class Transitions(NamedTuple):
    """B steps: each array as in :class:`Arrays`, (B, ...)."""

    observations: Array
    actions: Array
    rewards: Array
    next_observations: Array
    terminations: Array
    truncations: Array
    variant_index: Array


# One array a row of steps each; the other fields of Arrays are about episodes.
STEP_ARRAYS = Transitions._fields
_CACHED = (*STEP_ARRAYS, "episode_starts")
# Rows that are worked on at once, where a temporary copy is needed.
_BLOCK = 4096


class Trajectory(NamedTuple):
    """One episode of T steps: observations (T+1, obs), actions (T, act), rewards (T,), and how it ended."""

    observations: Array
    actions: Array
    rewards: Array
    terminated: bool
    truncated: bool


@dataclass(frozen=True, eq=False)
class Statistics:
    """Mean and standard deviation (obs,) of observations, in float64."""

    mean: Array
    std: Array

    def normalize(self, observations: Array) -> Array:
        """Return ``(observations - mean) / std``."""
        return ((observations - self.mean) / self.std).astype(observations.dtype, copy=False)

    def tolist(self) -> list[list[float]]:
        """Return mean and standard deviation as lists, which JSON can hold."""
        return [self.mean.tolist(), self.std.tolist()]

    def denormalize(self, observations: Array) -> Array:
        """Return ``observations * std + mean``."""
        return (observations * self.std + self.mean).astype(observations.dtype, copy=False)


@dataclass(frozen=True, eq=False)
class Arrays:
    """Steps of many episodes, one after the other.

    Attributes:
        observations: (N, obs), before each step.
        actions: (N, act).
        rewards: (N,).
        next_observations: (N, obs), after each step, that which ends an episode included.
        terminations: (N,) bool; the episode ended here, by the task's rules.
        truncations: (N,) bool; it was cut here.
        variant_index: (N,) int32; each row's row of ``table``.
        episode_starts: (E,) int64; the first row of each episode.
        table: variant, robot, category, body, percent and tier, for each that occurs.
        statistics: what the observations were normalised with; None where they were not.
    """

    observations: Array
    actions: Array
    rewards: Array
    next_observations: Array
    terminations: Array
    truncations: Array
    variant_index: Array
    episode_starts: Array
    table: tuple[Origin, ...]
    statistics: Statistics | None = None

    def __len__(self) -> int:
        """The number of steps."""
        return len(self.rewards)

    @property
    def episodes(self) -> int:
        """The number of episodes."""
        return len(self.episode_starts)

    @property
    def episode_ends(self) -> Array:
        """(E,) int64; the row after the last of each episode."""
        return np.append(self.episode_starts[1:], len(self))

    @property
    def episode_lengths(self) -> Array:
        """(E,) int64; the steps of each episode."""
        return self.episode_ends - self.episode_starts

    @property
    def episode_variants(self) -> Array:
        """(E,) int32; each episode's row of ``table``."""
        return self.variant_index[self.episode_starts]

    @property
    def origins(self) -> list[Origin]:
        """Variant and tier of each episode."""
        return [self.table[place] for place in self.episode_variants]

    @property
    def returns(self) -> Array:
        """(E,) float64; the undiscounted return of each episode."""
        return np.add.reduceat(self.rewards, self.episode_starts, dtype=np.float64)

    @property
    def dones(self) -> Array:
        """(N,) bool; terminated or truncated."""
        return self.terminations | self.truncations

    def rows(self, episode: int) -> slice:
        """Return the rows of one episode."""
        start = int(self.episode_starts[episode])
        last = episode in (-1, self.episodes - 1)
        return slice(start, len(self) if last else int(self.episode_starts[episode + 1]))

    def trajectory(self, episode: int) -> Trajectory:
        """Return one episode, its final observation included."""
        rows = self.rows(episode)
        observations = np.concatenate((self.observations[rows], self.next_observations[rows][-1:]))
        last = rows.stop - 1
        return Trajectory(
            observations,
            self.actions[rows],
            self.rewards[rows],
            bool(self.terminations[last]),
            bool(self.truncations[last]),
        )

    def trajectories(self) -> Iterator[Trajectory]:
        """Yield every episode in order."""
        return (self.trajectory(episode) for episode in range(self.episodes))

    def select(self, episodes: Sequence[int] | Array) -> Arrays:
        """Return a copy that holds the numbered episodes, in the order given."""
        numbers = np.asarray(episodes, dtype=np.int64)
        if not len(numbers) or numbers.min() < 0 or numbers.max() >= self.episodes:
            raise DatasetError(f"episodes are numbered 0 to {self.episodes - 1}, and at least one is chosen")
        lengths = self.episode_lengths[numbers]
        starts = np.cumsum(lengths) - lengths
        rows = np.arange(lengths.sum()) + np.repeat(self.episode_starts[numbers] - starts, lengths)
        return replace(
            self, episode_starts=starts, **{name: getattr(self, name)[rows] for name in STEP_ARRAYS}
        )

    def portion(self, low: float, high: float, *, seed: int = 0) -> Arrays:
        """Return a copy of a share of each variant's and tier's episodes, as :func:`arrays` takes it."""
        return self.select(selection.portion_of(self.origins, (low, high), seed))


def arrays(
    datasets: Datasets,
    *,
    where: Mapping[str, Any] | None = None,
    portion: tuple[float, float] = (0.0, 1.0),
    seed: int = 0,
    dtype: DTypeLike | None = None,
    normalize: bool | Statistics = False,
    cache: bool = False,
) -> Arrays:
    """Load datasets as contiguous arrays.

    Args:
        datasets: a Minari dataset or its id, or several; collections and filtered views too.
        where: keep the episodes with these attributes, as ``{"category": "mass", "percent": [-50, -25]}``;
            the keys are variant, robot, category, body, percent and tier.
        portion: keep this share of each variant's and tier's episodes, after a shuffle by ``seed``:
            (0, 0.75) to train with, (0.75, 1) to test.
        seed: of that shuffle.
        dtype: of observations and rewards, ``numpy.float32`` for most learners; None leaves them as stored.
        normalize: shift and scale observations, by their own statistics or by those given (the test
            share by the training share's); the result keeps them.
        cache: keep the result on disk, and map it when the same is asked for again.

    Returns:
        The arrays, episodes in the order of the datasets.

    Raises:
        DatasetNotFoundError: when an id names no dataset of the Minari root.
        VariantError: when ``where`` names no attribute, or a value that no episode has.
        DatasetError: when the datasets' shapes differ, or they are of no such kind.
    """
    chosen = selection.sources(datasets)
    criteria = dict(where or {})
    if not cache:
        return _load(chosen, criteria, portion, seed, dtype, normalize)
    normalized = normalize.tolist() if isinstance(normalize, Statistics) else normalize
    key = array_cache.key(chosen, criteria, portion, seed, dtype, normalized)
    if found := _cached(key):
        return found
    loaded = _load(chosen, criteria, portion, seed, dtype, normalize)
    described = {
        "table": [asdict(origin) for origin in loaded.table],
        "statistics": loaded.statistics and loaded.statistics.tolist(),
    }
    array_cache.store(key, {name: getattr(loaded, name) for name in _CACHED}, described)
    return _cached(key) or loaded


def _cached(key: str) -> Arrays | None:
    """Return an entry of the cache, or None when there is none."""
    entry = array_cache.load(key, _CACHED)
    if entry is None:
        return None
    mapped, described = entry
    statistics = described["statistics"] and Statistics(*map(np.array, described["statistics"]))
    table = tuple(Origin(**origin) for origin in described["table"])
    return Arrays(**mapped, table=table, statistics=statistics)


def _load(
    chosen: Sequence[selection.Source],
    where: Mapping[str, Any],
    portion: tuple[float, float],
    seed: int,
    dtype: DTypeLike | None,
    normalize: bool | Statistics,
) -> Arrays:
    with ExitStack() as stack:
        files = {
            source: stack.enter_context(EpisodeFile(source.file, source.dataset_id))
            for source in dict.fromkeys(chosen)
        }
        found = [episode for source in chosen for episode in selection.episodes(source, files[source])]
        if not found:
            raise DatasetError("the datasets hold no episodes")
        kept = selection.matching(found, where)
        share = selection.portion_of([episode.origin for episode in kept], portion, seed)
        kept = [kept[place] for place in share]
        result = _fill(kept, files, dtype)
    if normalize is False:
        return result
    statistics = measure(result.observations) if normalize is True else normalize
    shape = result.observations.shape[1:]
    if statistics.mean.shape != shape:
        raise DatasetError(f"statistics of {statistics.mean.shape} do not fit observations of {shape}")
    for array in (result.observations, result.next_observations):
        for block in _blocks(array):
            block[...] = statistics.normalize(block)
    return replace(result, statistics=statistics)


def _fill(
    kept: Sequence[Episode], files: Mapping[selection.Source, EpisodeFile], dtype: DTypeLike | None
) -> Arrays:
    """Allocate the arrays of all kept episodes, and read each episode into its rows."""
    lengths = np.array([files[e.source].length(e.number) for e in kept], dtype=np.int64)
    if not lengths.all():
        raise DatasetError(f"{kept[int(lengths.argmin())].source.dataset_id} holds an episode without steps")
    ends = np.cumsum(lengths)
    starts = ends - lengths
    first = files[kept[0].source]
    layouts = {name: first.layout(kept[0].number, name) for name in ("observations", "actions", "rewards")}
    if any(len(layouts[name][0]) != 2 for name in ("observations", "actions")):
        raise DatasetError(
            f"{first.name}: observations and actions must be vectors, not of shapes "
            f"{layouts['observations'][0][1:]} and {layouts['actions'][0][1:]}"
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
    # Read as they are stored, then split and converted by NumPy, which is quicker at it than HDF5.
    scratch, scratch_rewards = empty("observations", rows=longest + 1), empty("rewards", rows=longest)
    for episode, start, end in zip(kept, starts.tolist(), ends.tolist(), strict=True):
        both, earned = scratch[: end - start + 1], scratch_rewards[: end - start]
        files[episode.source].read(
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


def measure(observations: Array) -> Statistics:
    """Return mean and standard deviation of observations (N, obs); a constant one keeps the scale 1."""
    mean = observations.mean(axis=0, dtype=np.float64)
    total = np.zeros_like(mean)
    for block in _blocks(observations):
        total += np.square(block - mean).sum(axis=0)
    std = np.sqrt(total / len(observations))
    return Statistics(mean, np.where(std > 0, std, 1.0))


def _blocks(array: Array) -> Iterator[Array]:
    return (array[start : start + _BLOCK] for start in range(0, len(array), _BLOCK))
