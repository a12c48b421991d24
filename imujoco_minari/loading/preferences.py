"""Preference pairs: two segments of episodes of one variant, and which of them is preferred.

The preferred segment is the one with the larger return or, if a ranking of tiers is given, the one of the
better tier: an expert's segment over a random policy's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from imujoco_minari.errors import ArgumentError, DatasetError, as_path, clipped, suggestion, whole_number
from imujoco_minari.loading.batches import Windows, gather_windows, window_starts
from imujoco_minari.loading.episode_arrays import Arrays
from imujoco_minari.short_repr import short_repr
from imujoco_minari.storage.targets import new_target

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Preferences:
    """P pairs of segments of L steps.

    Attributes:
        first: the first segment of each pair, arrays (P, L, ...).
        second: the second segment of each pair.
        preferred: (P,) int64; 0 where the first segment is preferred, 1 where the second is.
        scores: (P, 2) float64; the compared values: the return of the segment, or minus the rank of its tier.
    """

    first: Windows
    second: Windows
    preferred: Array
    scores: Array

    __repr__ = short_repr

    def save(self, path: Path | str, *, force: bool = False) -> None:
        """Write a ``.npz`` file: ``first_observations`` (P, L, obs) and so on, ``preferred``, ``scores``.

        Raises:
            DatasetExistsError: when ``path`` exists, and ``force`` is false or it is no such file.
            StorageError: when it cannot be written.
        """
        columns = {"preferred": self.preferred, "scores": self.scores}
        for side, windows in (("first", self.first), ("second", self.second)):
            columns |= {f"{side}_{name}": array for name, array in windows._asdict().items()}
        with new_target(as_path(path), force=force) as staged, staged.open("wb") as file:
            np.savez(file, **columns)  # type: ignore[arg-type]


def preference_pairs(
    data: Arrays,
    *,
    pairs: int = 1000,
    length: int = 50,
    tiers: Sequence[str] | None = None,
    seed: int = 0,
) -> Preferences:
    """Draw pairs of segments, and label which of the two is preferred.

    Both segments of a pair are of one variant. No pair has equal scores.

    Args:
        data: arrays of one or many variants; of several tiers, if ``tiers`` ranks them.
        pairs: number of pairs.
        length: steps of a segment; each segment lies within one episode.
        tiers: the tiers from best to worst, as ``("expert", "medium", "random")``; None ranks by return.
        seed: of the draws.

    Raises:
        DatasetError: when all segments of a variant have one score, or ``tiers`` lacks a tier of the data.
        ArgumentError: when an argument is not valid.

    Example:
        >>> chosen = preference_pairs(data, pairs=500, length=25, seed=0)  # doctest: +SKIP
        >>> chosen.first.observations.shape  # doctest: +SKIP
        (500, 25, 11)
    """
    whole_number(pairs, "pairs", least=1)
    starts = window_starts(data, length)
    if not np.isfinite(data.rewards).all():
        raise DatasetError("no segment can be preferred: the rewards hold NaN or infinity")
    if tiers is None:
        # Differences of cumulative sums would round equal segments differently.
        scores = sliding_window_view(data.rewards.astype(np.float64), length).sum(axis=1)[starts]
    else:
        scores = _tier_scores(data, tiers)[starts]
    names = [origin.variant for origin in data.table]
    variants = np.array([names.index(name) for name in names])[data.variant_index[starts]]
    rng = np.random.default_rng(whole_number(seed, "seed", least=0))
    present, segments = np.unique(variants, return_counts=True)
    # In proportion to the number of segments of each variant. A single segment makes no pair: where each
    # episode draws its variant, an episode of ``length`` steps is the only segment of its variant.
    weights = segments * (segments > 1) if segments.max() > 1 else segments
    counts = rng.multinomial(pairs, weights / weights.sum())
    drawn = [
        _draw(np.flatnonzero(variants == variant), scores, count, names[variant], rng)
        for variant, count in zip(present.tolist(), counts.tolist(), strict=True)
        if count
    ]
    chosen = rng.permutation(np.concatenate(drawn))
    compared = scores[chosen]
    return Preferences(
        gather_windows(data, starts[chosen[:, 0]], length),
        gather_windows(data, starts[chosen[:, 1]], length),
        (compared[:, 1] > compared[:, 0]).astype(np.int64),
        compared,
    )


def _draw(candidates: Array, scores: Array, count: int, name: str, rng: np.random.Generator) -> Array:
    """Return ``count`` pairs (count, 2) of candidates that differ in score."""
    if np.ptp(scores[candidates]) == 0:
        raise DatasetError(f"all segments of {name or 'the dataset'} have the same score: no pair to prefer")
    found = np.empty((0, 2), np.int64)
    while len(found) < count:
        drawn = rng.choice(candidates, size=(2 * count, 2))
        found = np.concatenate((found, drawn[scores[drawn[:, 0]] != scores[drawn[:, 1]]]))
    return found[:count]


def _tier_scores(data: Arrays, tiers: Sequence[str]) -> Array:
    several = isinstance(tiers, Sequence) and not isinstance(tiers, str)
    if not several or not all(isinstance(tier, str) for tier in tiers):
        raise ArgumentError(
            f"tiers must be a list from best to worst, as ['expert', 'random'], not {clipped(repr(tiers))}"
        )
    places = {tier: place for place, tier in enumerate(tiers)}
    for origin in data.table:
        if origin.tier not in places:
            raise DatasetError(
                f"the data has the tier {origin.tier!r}{suggestion(origin.tier, places)}, "
                f"which is not in tiers: {', '.join(tiers)}"
            )
    scores: Array = np.array([-float(places[origin.tier]) for origin in data.table])
    return scores[data.variant_index]
