"""Ranked data as pairs: two stretches of steps of one variant, and which of them is preferred.

The preference is that of the tiers, where a ranking of them is given (an expert's stretch over a random
one's), or that of the return within the stretch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import DatasetError, suggestion
from imujoco_minari.loading.load import Arrays
from imujoco_minari.loading.sampling import Windows, gather_windows, window_starts
from imujoco_minari.storage.targets import new_target

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Preferences:
    """P pairs of stretches of L steps.

    Attributes:
        first: the one stretch of each pair, arrays (P, L, ...).
        second: the other.
        preferred: (P,) int64; 0 where the first is preferred, 1 where the second is.
        scores: (P, 2) float64; what was compared: return of the stretch, or minus the tier's place.
    """

    first: Windows
    second: Windows
    preferred: Array
    scores: Array

    def save(self, path: Path, *, force: bool = False) -> None:
        """Write a ``.npz`` file: ``first_observations`` (P, L, obs) and so on, ``preferred``, ``scores``.

        Raises:
            DatasetExistsError: when ``path`` is there already, and ``force`` is false or it is no such file.
            StorageError: when it cannot be written.
        """
        columns = {"preferred": self.preferred, "scores": self.scores}
        for side, windows in (("first", self.first), ("second", self.second)):
            columns |= {f"{side}_{name}": array for name, array in windows._asdict().items()}
        with new_target(path, force=force) as staged, staged.open("wb") as file:
            np.savez(file, **columns)  # type: ignore[arg-type]


def preference_pairs(
    data: Arrays,
    *,
    pairs: int = 1000,
    length: int = 50,
    tiers: Sequence[str] | None = None,
    seed: int = 0,
) -> Preferences:
    """Draw pairs of stretches of one variant each, and say which of them is preferred.

    Args:
        data: arrays of one or many variants, of several tiers if these are to rank.
        pairs: how many.
        length: steps of a stretch; each lies within one episode.
        tiers: from the best to the worst, as ``("expert", "medium", "random")``; None ranks by return.
        seed: of the draws.

    Raises:
        DatasetError: when a variant has nothing to prefer, or ``tiers`` are not those of the data.
    """
    if pairs < 1:
        raise DatasetError(f"there is at least one pair, not {pairs}")
    starts = window_starts(data, length)
    scores = _tier_scores(data, tiers)[starts] if tiers else _returns(data, starts, length)
    names = [origin.variant for origin in data.table]
    variants = np.array([names.index(name) for name in names])[data.variant_index[starts]]
    rng = np.random.default_rng(seed)
    drawn = [
        _draw(np.flatnonzero(variants == variant), scores, count, names[variant], rng)
        for variant, count in zip(*_shares(variants, pairs, rng), strict=True)
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


def _shares(variants: Array, pairs: int, rng: np.random.Generator) -> tuple[list[int], list[int]]:
    """Return the variants, and how many of the pairs each gets, by its number of stretches."""
    present, counts = np.unique(variants, return_counts=True)
    return present.tolist(), rng.multinomial(pairs, counts / counts.sum()).tolist()


def _draw(candidates: Array, scores: Array, count: int, name: str, rng: np.random.Generator) -> Array:
    """Return ``count`` pairs (count, 2) of candidates that differ in score."""
    if np.ptp(scores[candidates]) == 0:
        raise DatasetError(
            f"all stretches of {name or 'the dataset'} rank the same: there is nothing to prefer"
        )
    found = np.empty((0, 2), np.int64)
    while len(found) < count:
        drawn = rng.choice(candidates, size=(2 * count, 2))
        found = np.concatenate((found, drawn[scores[drawn[:, 0]] != scores[drawn[:, 1]]]))
    return found[:count]


def _returns(data: Arrays, starts: Array, length: int) -> Array:
    sums = np.concatenate(([0.0], np.cumsum(data.rewards, dtype=np.float64)))
    returns: Array = sums[starts + length] - sums[starts]
    return returns


def _tier_scores(data: Arrays, tiers: Sequence[str]) -> Array:
    places = {tier: place for place, tier in enumerate(tiers)}
    for origin in data.table:
        if origin.tier not in places:
            raise DatasetError(
                f"the data has the tier {origin.tier!r}{suggestion(origin.tier, places)}, "
                f"which is not ranked among: {', '.join(tiers)}"
            )
    scores: Array = np.array([-float(places[origin.tier]) for origin in data.table])
    return scores[data.variant_index]
