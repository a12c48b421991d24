"""Batches out of arrays: transitions, windows and episodes, all seeded.

:class:`Sampler` is the convenience that the original benchmark shipped, so many whole episodes of one
variant: by episode instead of by a thousand rows, seeded, and with a mask where an episode ends early.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import count
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import DatasetError, VariantError, suggestion
from imujoco_minari.loading import selection
from imujoco_minari.loading.load import Arrays, Transitions, arrays
from imujoco_minari.loading.transitions import Packed, gather_transitions, take

if TYPE_CHECKING:
    from imujoco_minari.loading.selection import Datasets

Array = NDArray[Any]


# Rows that are gathered at once, whatever the batches: a call of NumPy costs as much as those of a small one.
_AHEAD = 8192


class Windows(NamedTuple):
    """B stretches of L successive steps of one episode each: (B, L, ...).

    ``mask`` (B, L) is true where there is a step; beyond an episode's end everything is zero.
    ``timesteps`` (B, L) counts from the episode's start.
    """

    observations: Array
    actions: Array
    rewards: Array
    timesteps: Array
    variant_index: Array
    mask: Array


class Shots(NamedTuple):
    """Whole episodes: observations (shots, horizon, obs) and actions (shots, horizon, act), float32.

    ``mask`` (shots, horizon) is true where there is a step; beyond an episode's end everything is zero.
    """

    observations: Any
    actions: Any
    mask: Any


class FewShot(NamedTuple):
    """Episodes to adapt on and to be judged by, of the same variants."""

    support: Arrays
    query: Arrays


class Sampler:
    """Draws whole episodes of one variant, as the original benchmark's sampler does.

    Args:
        data: arrays, or datasets or their ids.
        portion: share of each variant's episodes to draw from: (0, 0.75) to train, (0.75, 1) to test.
        seed: of the split and of all draws. Samplers of one seed and disjoint portions share no episode.
        horizon: steps an episode is padded or cut to.
        where: keep the episodes with these attributes (see :func:`~imujoco_minari.loading.load.arrays`).
        torch: return torch tensors instead of NumPy arrays.

    Attributes:
        arrays: what it draws from.
    """

    def __init__(
        self,
        data: Arrays | Datasets,
        *,
        portion: tuple[float, float] = (0.0, 0.75),
        seed: int = 0,
        horizon: int = 1000,
        where: Mapping[str, Any] | None = None,
        torch: bool = False,
    ) -> None:
        if horizon < 1:
            raise DatasetError(f"horizon must be at least 1, not {horizon}")
        if not isinstance(data, Arrays):
            data = arrays(data, where=where, portion=portion, seed=seed, dtype=np.float32)
        elif where:
            raise DatasetError("arrays are filtered when they are loaded: give `where` to arrays()")
        else:
            data = data.portion(*portion, seed=seed)
        self.arrays = data
        self._horizon, self._torch = horizon, torch
        self._rng = np.random.default_rng(seed)
        variants = data.episode_variants
        self._episodes = [np.flatnonzero(variants == place) for place in range(len(data.table))]
        self._lengths = np.minimum(data.episode_lengths, horizon)

    def __len__(self) -> int:
        """The number of variants (and tiers) to draw from."""
        return len(self.arrays.table)

    def sample(self, tot_shots: int = 5, idx: int | str | None = None, replace: bool = False) -> Shots:
        """Draw episodes of one variant.

        Args:
            tot_shots: how many.
            idx: which variant, by its number in ``arrays.table`` or its id; None draws one.
            replace: whether an episode may be drawn twice.

        Raises:
            VariantError: when there is no such variant.
            DatasetError: when the variant has fewer episodes than asked for without replacement.
        """
        place = int(self._rng.integers(len(self))) if idx is None else self._place(idx)
        episodes = self._episodes[place]
        if tot_shots < 1 or (tot_shots > len(episodes) and not replace):
            raise DatasetError(
                f"{self.arrays.table[place].variant} has {len(episodes)} episodes in this portion: "
                f"{tot_shots} cannot be drawn{'' if tot_shots < 1 else ' without replacement'}"
            )
        drawn = self._rng.choice(episodes, size=tot_shots, replace=replace)
        starts, lengths = self.arrays.episode_starts[drawn], self._lengths[drawn]
        observations, actions = (
            _padded(column, starts, lengths, self._horizon).astype(np.float32, copy=False)
            for column in (self.arrays.observations, self.arrays.actions)
        )
        shots = Shots(observations, actions, np.arange(self._horizon) < lengths[:, None])
        return Shots(*map(_tensor, shots)) if self._torch else shots

    def _place(self, idx: int | str) -> int:
        if isinstance(idx, str):
            names = [origin.variant for origin in self.arrays.table]
            if idx not in names:
                raise VariantError(
                    f"the sampler has no variant {idx!r}{suggestion(idx, names)}; it has {', '.join(names)}"
                )
            return names.index(idx)
        if not 0 <= idx < len(self):
            raise VariantError(f"variant {idx} is none of the sampler's, 0 to {len(self) - 1}")
        return int(idx)


def few_shot(data: Arrays, *, shots: int = 5, queries: int | None = None, seed: int = 0) -> FewShot:
    """Split every variant's episodes into a support and a query set.

    Args:
        data: arrays of one or many variants.
        shots: support episodes of each variant (and tier).
        queries: query episodes of each; None for all the others.
        seed: draws which are which; a variant's episodes do not depend on the others in ``data``.

    Raises:
        DatasetError: when a variant has too few episodes.
    """
    if shots < 1 or (queries is not None and queries < 1):
        raise DatasetError("a support and a query set have at least one episode of each variant")
    support: list[int] = []
    query: list[int] = []
    for order in selection.shuffled(data.origins, seed):
        needed = shots + (1 if queries is None else queries)
        if len(order) < needed:
            raise DatasetError(
                f"{data.origins[order[0]].variant} has {len(order)} episodes, "
                f"and {shots} shots and a query set need {needed}"
            )
        support += sorted(order[:shots])
        query += sorted(order[shots : None if queries is None else shots + queries])
    return FewShot(data.select(support), data.select(query))


def gather_windows(data: Arrays, starts: Array, length: int) -> Windows:
    """Return the windows of ``length`` steps that begin at the rows ``starts``, padded with zeros."""
    starts = np.asarray(starts, dtype=np.int64)
    episodes = np.searchsorted(data.episode_starts, starts, side="right") - 1
    rows = starts[:, None] + np.arange(length)
    mask = rows < data.episode_ends[episodes][:, None]
    # A row beyond the end reads the window's first, and is then blanked.
    rows = np.where(mask, rows, starts[:, None])
    timesteps = rows - data.episode_starts[episodes][:, None]
    names = ("observations", "actions", "rewards")
    observations, actions, rewards = (take(getattr(data, name), rows) for name in names)
    for column in (observations, actions, rewards, timesteps):
        column[~mask] = 0
    return Windows(observations, actions, rewards, timesteps, data.variant_index[starts], mask)


def gather_episodes(data: Arrays, episodes: Array, length: int) -> Windows:
    """Return the first ``length`` steps of these episodes, padded with zeros.

    The same as windows from their starts, in half the time: an episode is copied in one piece.
    """
    starts = data.episode_starts[episodes]
    lengths = np.minimum(data.episode_lengths[episodes], length)
    timesteps = np.arange(length)
    mask = timesteps < lengths[:, None]
    return Windows(
        _padded(data.observations, starts, lengths, length),
        _padded(data.actions, starts, lengths, length),
        _padded(data.rewards, starts, lengths, length),
        timesteps * mask,
        data.variant_index[starts],
        mask,
    )


def _padded(column: Array, starts: Array, lengths: Array, length: int) -> Array:
    """Return the first rows of episodes, (episodes, length, ...), zero beyond ``lengths``."""
    several = np.empty((len(starts), length, *column.shape[1:]), column.dtype)
    for episode, start, steps in zip(several, starts.tolist(), lengths.tolist(), strict=True):
        episode[:steps] = column[start : start + steps]
        episode[steps:] = 0
    return several


def window_starts(data: Arrays, length: int, *, padded: bool = False) -> Array:
    """Return the rows at which a window of ``length`` steps may begin.

    Args:
        data: the arrays.
        length: steps of a window.
        padded: any row, the window then ends with its episode; otherwise those with ``length`` steps left.

    Raises:
        DatasetError: when no episode is so long.
    """
    if length < 1:
        raise DatasetError(f"a window has at least one step, not {length}")
    if padded:
        return np.arange(len(data))
    left = np.repeat(data.episode_ends, data.episode_lengths) - np.arange(len(data))
    starts = np.flatnonzero(left >= length)
    if not len(starts):
        raise DatasetError(
            f"no episode has {length} steps, the longest has {data.episode_lengths.max()}: "
            "shorten the window, or pad it"
        )
    return starts


def transition_batches(data: Arrays | Packed, batch_size: int, *, seed: int = 0) -> Iterator[Transitions]:
    """Yield all steps once, in an order drawn by ``seed``, as batches; the last may be smaller.

    Packed data (:func:`~imujoco_minari.loading.transitions.pack`) gives the same batches in half the time.
    """
    # Half the bytes of an index take half the time to shuffle.
    rows = np.arange(len(data), dtype=np.min_scalar_type(-len(data)))
    ahead = _batches(rows, batch_size, seed, at_once=_batches_ahead(batch_size))
    return (batch for rows in ahead for batch in _split(gather_transitions(data, rows), batch_size))


def transition_samples(data: Arrays | Packed, batch_size: int, *, seed: int = 0) -> Iterator[Transitions]:
    """Yield batches without end, every step drawn anew from all, as a replay buffer samples.

    Packed data (:func:`~imujoco_minari.loading.transitions.pack`) gives the same batches in half the time.
    """
    rng, size = np.random.default_rng(seed), batch_size * _batches_ahead(batch_size)
    ahead = (rng.integers(len(data), size=size) for _ in count())
    return (batch for rows in ahead for batch in _split(gather_transitions(data, rows), batch_size))


def window_batches(
    data: Arrays, length: int, batch_size: int, *, seed: int = 0, padded: bool = False
) -> Iterator[Windows]:
    """Yield all windows of ``length`` steps once, in an order drawn by ``seed``, as batches."""
    starts = window_starts(data, length, padded=padded)
    return (gather_windows(data, batch, length) for batch in _batches(starts, batch_size, seed))


def episode_batches(data: Arrays, batch_size: int, *, seed: int = 0) -> Iterator[Windows]:
    """Yield all episodes once, in an order drawn by ``seed``, padded to the longest of their batch."""
    for batch in _batches(np.arange(data.episodes), batch_size, seed):
        yield gather_episodes(data, batch, int(data.episode_lengths[batch].max()))


def _batches(items: Array, batch_size: int, seed: int, at_once: int = 1) -> Iterator[Array]:
    _check_size(batch_size)
    order = np.random.default_rng(seed).permutation(items)
    size = batch_size * at_once
    return (order[start : start + size] for start in range(0, len(order), size))


def _batches_ahead(batch_size: int) -> int:
    _check_size(batch_size)
    return max(1, _AHEAD // batch_size)


def _check_size(batch_size: int) -> None:
    if batch_size < 1:
        raise DatasetError(f"a batch holds at least one, not {batch_size}")


def _split(several: Transitions, batch_size: int) -> Iterator[Transitions]:
    whole = len(several.rewards) // batch_size
    # Walking along an axis of batches takes half the time of slicing.
    batches = (
        column[: whole * batch_size].reshape(whole, batch_size, *column.shape[1:]) for column in several
    )
    yield from map(Transitions._make, zip(*batches, strict=True))
    if whole * batch_size < len(several.rewards):
        yield Transitions(*(column[whole * batch_size :] for column in several))


def _tensor(array: Array) -> Any:
    import torch

    return torch.from_numpy(array)
