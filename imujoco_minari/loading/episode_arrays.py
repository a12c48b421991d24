"""The container of loaded data: the steps of many episodes as arrays, and how they are saved to a folder."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import NDArray

from imujoco_minari.errors import ArgumentError, DatasetError, as_path, clipped
from imujoco_minari.loading import selection
from imujoco_minari.loading.selection import Origin
from imujoco_minari.loading.statistics import Statistics
from imujoco_minari.short_repr import short_repr
from imujoco_minari.storage.targets import new_target

Array = NDArray[Any]


class TransitionBatch(NamedTuple):
    """B steps: each array as in :class:`Arrays`, (B, ...)."""

    observations: Array
    actions: Array
    rewards: Array
    next_observations: Array
    terminations: Array
    truncations: Array
    variant_index: Array

    def __repr__(self) -> str:
        return short_repr(self)


# The fields of Arrays with one row for each step.
STEP_ARRAYS = TransitionBatch._fields
# A folder of saved arrays holds each of these as .npy, and the rest in one JSON file.
_SAVED_ARRAYS = (*STEP_ARRAYS, "episode_starts")
_DESCRIPTION = "arrays.json"


class Trajectory(NamedTuple):
    """One episode of T steps: observations (T+1, obs), actions (T, act), rewards (T,), and how it ended."""

    observations: Array
    actions: Array
    rewards: Array
    terminated: bool
    truncated: bool

    def __repr__(self) -> str:
        return short_repr(self)


@dataclass(frozen=True, eq=False, repr=False)
class Arrays:
    """The steps of many episodes of one robot, one episode after the other.

    Attributes:
        observations: (N, obs), before each step.
        actions: (N, act).
        rewards: (N,).
        next_observations: (N, obs), after each step. The last step of an episode has its final observation.
        terminations: (N,) bool; the episode ended here by the rules of the task.
        truncations: (N,) bool; the episode was cut here.
        variant_index: (N,) int32; the row of ``table`` for each step.
        episode_starts: (E,) int64; the first row of each episode.
        table: variant, robot, category, body, percent, tier and changes, one row for each combination that
            occurs.
        statistics: the statistics that normalised the observations; None if they are not normalised.
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

    def __repr__(self) -> str:
        robots, variants, tiers = (
            list(dict.fromkeys(getattr(origin, name) for origin in self.table))
            for name in ("robot", "variant", "tier")
        )
        size = sum(array.nbytes for array in vars(self).values() if isinstance(array, np.ndarray))
        named = variants[0] if len(variants) == 1 else f"{len(variants)} variants of {', '.join(robots)}"
        normalized = ", normalised" if self.statistics is not None else ""
        return (
            f"Arrays({named}, {'/'.join(tiers)}: {self.episodes} episodes, {len(self)} transitions, "
            f"{self.observations.dtype}{normalized}, {size / 1e6:.1f} MB)"
        )

    def __len__(self) -> int:
        """The number of steps."""
        return len(self.rewards)

    @property
    def episodes(self) -> int:
        """The number of episodes."""
        return len(self.episode_starts)

    @property
    def episode_ends(self) -> Array:
        """(E,) int64; the row after the last row of each episode."""
        return np.append(self.episode_starts[1:], len(self))

    @property
    def episode_lengths(self) -> Array:
        """(E,) int64; the number of steps of each episode."""
        return self.episode_ends - self.episode_starts

    @property
    def episode_variants(self) -> Array:
        """(E,) int32; the row of ``table`` for each episode."""
        return self.variant_index[self.episode_starts]

    @property
    def origins(self) -> list[Origin]:
        """The variant and the tier of each episode."""
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
        """Return one episode, with its final observation."""
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
        """Yield every episode, in order."""
        return (self.trajectory(episode) for episode in range(self.episodes))

    def select(self, episodes: Sequence[int] | Array) -> Arrays:
        """Return a copy of the episodes with these numbers, in the given order.

        Raises:
            DatasetError: when ``episodes`` is empty, or has a number that no episode has.
            ArgumentError: when ``episodes`` is not a list of whole numbers.
        """
        try:
            numbers = np.asarray(episodes)
            valid = numbers.ndim == 1 and (numbers.dtype.kind in "iu" or not len(numbers))
        except ValueError:
            valid = False
        if not valid:
            raise ArgumentError(f"episodes must be a list of whole numbers, not {clipped(repr(episodes))}")
        if not len(numbers) or numbers.min() < 0 or numbers.max() >= self.episodes:
            raise DatasetError(f"select at least one episode; valid: 0 to {self.episodes - 1}")
        lengths = self.episode_lengths[numbers]
        starts = np.cumsum(lengths) - lengths
        rows = np.arange(lengths.sum()) + np.repeat(self.episode_starts[numbers] - starts, lengths)
        return replace(
            self, episode_starts=starts, **{name: getattr(self, name)[rows] for name in STEP_ARRAYS}
        )

    def portion(self, low: float, high: float, *, seed: int = 0) -> Arrays:
        """Return a copy of a share of each variant's and tier's episodes; see :func:`arrays`."""
        return self.select(selection.portion_of(self.origins, (low, high), seed))

    def save(self, path: Path | str, *, force: bool = False) -> None:
        """Save to a new folder: one ``.npy`` file for each array, and ``arrays.json`` for the rest.

        The folder appears complete or not at all. :meth:`load` reads it.

        Args:
            path: the folder to make.
            force: replace a folder of saved arrays that has this path.

        Raises:
            DatasetExistsError: when ``path`` exists, unless ``force`` is set and it is an export of ours.
            StorageError: when the folder cannot be written.
        """
        path = as_path(path)
        description = {
            "table": [asdict(origin) for origin in self.table],
            "statistics": self.statistics and self.statistics.tolist(),
        }
        with new_target(path, force=force) as staged:
            staged.mkdir()
            for name in _SAVED_ARRAYS:
                np.save(staged / f"{name}.npy", getattr(self, name), allow_pickle=False)
            (staged / _DESCRIPTION).write_text(json.dumps(description), "utf-8")

    @staticmethod
    def load(path: Path | str, *, mmap: bool = False) -> Arrays:
        """Load a folder that :meth:`save` wrote. Nothing is ever unpickled.

        Args:
            path: the folder.
            mmap: map the files into memory instead of reading them. This takes milliseconds, and data
                is read from the disk when it is used. Changes to the arrays never reach the files.

        Raises:
            DatasetError: when ``path`` is not such a folder, or is damaged.
        """
        path = as_path(path)
        try:
            description = json.loads((path / _DESCRIPTION).read_text("utf-8"))
            table = tuple(Origin(**origin) for origin in description["table"])
            statistics = description["statistics"] and Statistics(*map(np.array, description["statistics"]))
            # A mapped array cannot be larger than its file, whatever its header states.
            saved = {name: open_memmap(path / f"{name}.npy", mode="c") for name in _SAVED_ARRAYS}
            if len({len(saved[name]) for name in STEP_ARRAYS}) > 1:
                raise ValueError("its arrays differ in length")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DatasetError(f"{path} is not a folder that Arrays.save() wrote: {error}") from None
        arrays = saved if mmap else {name: np.array(array) for name, array in saved.items()}
        return Arrays(**arrays, table=table, statistics=statistics)


def check_arrays(data: Any) -> None:
    """Raise an ArgumentError unless ``data`` is :class:`Arrays`."""
    if not isinstance(data, Arrays):
        raise ArgumentError(f"expected the result of arrays(), not {type(data).__name__}")
