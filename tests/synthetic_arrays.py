"""Arrays made of numbers that say where they belong, for tests that need no simulator."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from imujoco_minari.loading import Arrays, Origin

BASE = Origin("hopper-base", "hopper", "base", "", 0, "expert")
LEG = Origin("hopper-massdec_25_leggeom", "hopper", "mass", "leggeom", -25, "expert")
RANDOM = Origin("hopper-base", "hopper", "base", "", 0, "random")


def synthetic(
    lengths: Sequence[int], origins: Sequence[Origin] | None = None, truncated: Sequence[int] = ()
) -> Arrays:
    """Return episodes of these lengths; observation t of episode e is (e, t, 0.5), the reward t + 1.

    Args:
        lengths: steps of each episode.
        origins: of each episode; all are BASE without it.
        truncated: which episodes are truncated; the others are terminated.
    """
    origins = list(origins or [BASE] * len(lengths))
    table = tuple(dict.fromkeys(origins))
    episode = np.repeat(np.arange(len(lengths)), lengths).astype(float)
    step = np.concatenate([np.arange(length) for length in lengths]).astype(float)
    half = np.full(len(step), 0.5)
    ends = np.cumsum(lengths) - 1
    cut = np.isin(np.arange(len(lengths)), list(truncated))
    terminations, truncations = np.zeros(len(step), bool), np.zeros(len(step), bool)
    terminations[ends[~cut]] = True
    truncations[ends[cut]] = True
    return Arrays(
        observations=np.column_stack([episode, step, half]),
        actions=np.column_stack([-step, episode]).astype(np.float32),
        rewards=step + 1,
        next_observations=np.column_stack([episode, step + 1, half]),
        terminations=terminations,
        truncations=truncations,
        variant_index=np.repeat([table.index(origin) for origin in origins], lengths).astype(np.int32),
        episode_starts=np.concatenate(([0], ends[:-1] + 1)).astype(np.int64),
        table=table,
    )
