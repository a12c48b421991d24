"""Whole episodes of one variant: the sampler of the original benchmark, and few-shot splits.

The original's sampler takes a thousand rows for an episode. :class:`Sampler` draws whole episodes, is seeded,
and returns a mask, since an episode may end early.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from imujoco_minari.errors import DatasetError, VariantError, clipped, listed, suggestion, whole_number
from imujoco_minari.loading import selection
from imujoco_minari.loading.batches import padded_rows
from imujoco_minari.loading.episode_arrays import Arrays, check_arrays
from imujoco_minari.loading.load import arrays
from imujoco_minari.loading.selection import Datasets
from imujoco_minari.short_repr import short_repr


class Shots(NamedTuple):
    """Whole episodes of one variant.

    Attributes:
        observations: (shots, horizon, obs) float32; zero after the end of an episode.
        actions: (shots, horizon, act) float32; zero after the end of an episode.
        mask: (shots, horizon) bool; true where there is a step.
        variant: the id of the variant, as ``hopper-massdec_25_leggeom``.
    """

    observations: Any
    actions: Any
    mask: Any
    variant: str

    def __repr__(self) -> str:
        return short_repr(self)


class FewShot(NamedTuple):
    """Episodes to adapt on (``support``) and to test on (``query``), of the same variants."""

    support: Arrays
    query: Arrays


class Sampler:
    """Draws whole episodes of one variant, as the sampler of the original benchmark does.

    Args:
        data: arrays, or datasets or their ids.
        portion: share of each variant's episodes to draw from: (0, 0.75) to train, (0.75, 1) to test.
        seed: of the split and of all draws. Samplers with one seed and disjoint portions share no episode.
        horizon: number of steps to which an episode is padded or cut.
        where: keep only episodes with these attributes (see :func:`~imujoco_minari.loading.arrays`).
        torch: return torch tensors instead of NumPy arrays.

    Attributes:
        arrays: the arrays of the portion.

    Raises:
        ImujocoError: what :func:`~imujoco_minari.loading.arrays` raises.

    Example:
        >>> sampler = Sampler("imujoco/hopper-base-v0", seed=0)  # doctest: +SKIP
        >>> observations, actions, mask, variant = sampler.sample(tot_shots=5)  # doctest: +SKIP
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
        self._horizon, self._torch = whole_number(horizon, "horizon", least=1), torch
        if not isinstance(data, Arrays):
            data = arrays(data, where=where, portion=portion, seed=seed, dtype=np.float32)
        elif where:
            raise DatasetError("arrays are filtered when they are loaded: pass `where` to arrays()")
        else:
            data = data.select(selection.portion_of(data.origins, portion, seed))
        self.arrays = data
        self._rng = np.random.default_rng(seed)
        variants = data.episode_variants
        self._episodes = [np.flatnonzero(variants == place) for place in range(len(data.table))]
        self._lengths = np.minimum(data.episode_lengths, self._horizon)

    def __repr__(self) -> str:
        return f"Sampler({self.arrays!r}, horizon {self._horizon})"

    def __len__(self) -> int:
        """The number of variants (and tiers) to draw from."""
        return len(self.arrays.table)

    def sample(self, tot_shots: int = 5, idx: int | str | None = None, replace: bool = False) -> Shots:
        """Draw episodes of one variant.

        Args:
            tot_shots: number of episodes.
            idx: the number of a variant (and tier) in ``arrays.table``, or the id of a variant; None draws a
                number that has episodes. If a variant has several tiers, its id draws one of them.
            replace: whether an episode may be drawn twice.

        Raises:
            VariantError: when the sampler has no such variant.
            DatasetError: when the variant has too few episodes.
        """
        whole_number(tot_shots, "tot_shots", least=1)
        place = self._place(idx)
        episodes, variant = self._episodes[place], self.arrays.table[place].variant
        if not len(episodes) or (tot_shots > len(episodes) and not replace):
            raise DatasetError(
                f"{variant} has {len(episodes)} episodes in this portion: "
                f"{tot_shots} cannot be drawn{' without replacement' if len(episodes) else ''}"
            )
        chosen = self._rng.choice(episodes, size=tot_shots, replace=replace)
        starts, lengths = self.arrays.episode_starts[chosen], self._lengths[chosen]
        drawn: list[Any] = [
            padded_rows(column, starts, lengths, self._horizon).astype(np.float32, copy=False)
            for column in (self.arrays.observations, self.arrays.actions)
        ]
        drawn.append(np.arange(self._horizon) < lengths[:, None])
        if self._torch:
            import torch

            drawn = [torch.from_numpy(array) for array in drawn]
        observations, actions, mask = drawn
        return Shots(observations, actions, mask, variant)

    def _place(self, idx: int | str | None) -> int:
        if idx is None:
            # A small portion may have no episode of a variant.
            present = [place for place, episodes in enumerate(self._episodes) if len(episodes)]
            return present[self._rng.integers(len(present))]
        names = [origin.variant for origin in self.arrays.table]
        if isinstance(idx, str) and idx in names:
            # Of several tiers, one is drawn.
            return int(self._rng.choice([place for place, name in enumerate(names) if name == idx]))
        if isinstance(idx, int | np.integer) and 0 <= idx < len(self):
            return int(idx)
        raise VariantError(
            f"the sampler has no variant {clipped(repr(idx))}{suggestion(str(idx), names)}; "
            f"valid: 0 to {len(self) - 1}, or {listed(names, selection.SHOWN_VALUES)}"
        )


def few_shot(data: Arrays, *, shots: int = 5, queries: int | None = None, seed: int = 0) -> FewShot:
    """Split the episodes of each variant into a support and a query set.

    Args:
        data: arrays of one or many variants.
        shots: support episodes of each variant (and tier).
        queries: query episodes of each variant; None for all that are not in the support set.
        seed: of the draw. The episodes drawn for a variant do not depend on the other variants in ``data``.

    Raises:
        DatasetError: when a variant has too few episodes.
        ArgumentError: when an argument is not valid.

    Example:
        >>> support, query = few_shot(data, shots=5, seed=0)  # doctest: +SKIP
    """
    check_arrays(data)
    whole_number(shots, "shots", least=1)
    whole_number(1 if queries is None else queries, "queries", least=1)
    whole_number(seed, "seed", least=0)
    support: list[int] = []
    query: list[int] = []
    for order, _ in selection.shuffled(data.origins, seed):
        needed = shots + (1 if queries is None else queries)
        if len(order) < needed:
            raise DatasetError(
                f"{data.origins[order[0]].variant} has {len(order)} episodes; "
                f"{shots} shots and a query set need {needed}"
            )
        support += sorted(order[:shots])
        query += sorted(order[shots : None if queries is None else shots + queries])
    return FewShot(data.select(support), data.select(query))
