"""Checks that an episode's arrays fit each other, and its length, flags and statistics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from imujoco_minari.storage import file_format
from imujoco_minari.variants import known_robots, specification
from imujoco_minari.verification.bounded_read import Episode
from imujoco_minari.verification.findings import Finding, differing, differs, same

# What the environments give. A replay in another type would round both sides before it compares them.
_TYPES: dict[str, np.dtype[Any]] = {
    "observations": np.dtype("<f8"),
    "actions": np.dtype("<f4"),
    "rewards": np.dtype("<f8"),
    "terminations": np.dtype(bool),
    "truncations": np.dtype(bool),
}


def length(episode: Episode) -> int:
    """Return an episode's number of steps; 0 where it has none."""
    rewards = episode.arrays.get("rewards")
    return rewards.shape[0] if rewards is not None and rewards.shape else 0


def arrays(episode: Episode) -> Iterator[Finding]:
    """Report arrays that are missing, or whose types and shapes do not fit."""
    for name in sorted(set(episode.arrays) - set(file_format.ARRAYS)):
        yield Finding(f"{episode.name}/{name}", "is an array that this package does not write")
    missing = [key for key in file_format.ARRAYS if key not in episode.arrays]
    if missing:
        yield Finding(episode.name, f"has no {missing[0]}")
        return
    steps = length(episode)
    if not steps:
        yield Finding(episode.name, "has no steps")
        return
    robot = str(episode.attributes.get("robot"))
    shapes: dict[str, tuple[int, ...]] = {
        "observations": (steps + 1, *episode.arrays["observations"].shape[1:2]),
        "actions": (steps, *episode.arrays["actions"].shape[1:2]),
    }
    if robot in known_robots():
        observation, action = specification(robot).sizes
        shapes = {"observations": (steps + 1, observation), "actions": (steps, action)}
    for key in file_format.ARRAYS:
        array, expected = episode.arrays[key], shapes.get(key, (steps,))
        if array.shape != expected or array.dtype != _TYPES[key]:
            kind = "flags" if _TYPES[key].kind == "b" else _TYPES[key]
            what = f"holds {array.dtype} of shape {array.shape}, not {kind} of shape {expected}"
            yield Finding(f"{episode.name}/{key}", what)
            return


def is_replayed(attributes: Mapping[str, Any]) -> bool:
    """Return whether an episode is replayed: all are, but those that were imported without seeds."""
    return not same(attributes.get(file_format.REPLAYABLE), False)


def values(episode: Episode, number: int, read: Mapping[str, Any]) -> Iterator[Finding]:
    """Report flags, statistics and values (``read``) of an episode that contradict each other."""
    name, attrs = episode.name, episode.attributes
    ends = read["terminations"] | read["truncations"]
    if ends[:-1].any():
        yield Finding(name, "goes on after a termination or truncation")
    if not ends[-1]:
        yield Finding(name, "ends without a termination or truncation")
    rewards, seed = read["rewards"], attrs.get("seed")
    # A linked episode has the number that it has in its source.
    wanted: dict[str, int | None] = {} if episode.linked else {"id": number}
    wanted |= {"total_steps": len(rewards)} | ({} if is_replayed(attrs) else {"seed": None})
    yield from differing(f"{name}@", attrs, wanted)
    if is_replayed(attrs) and (not isinstance(seed, np.integer) or not 0 <= seed < 2**63):
        yield differs(f"{name}@seed", seed, "a seed, so the episode cannot be replayed")
    for key in ("observations", "actions", "rewards"):
        if not np.isfinite(read[key]).all():
            yield Finding(f"{name}/{key}", "holds values that are not finite")
            return
    for statistic in ("sum", "mean", "std", "max", "min"):
        stated, value = attrs.get(f"rewards_{statistic}"), float(getattr(rewards, statistic)())
        # As numpy.isclose has it, at a fiftieth of its cost.
        tolerance = 1e-8 + 1e-9 * abs(value)
        if not (isinstance(stated, np.floating | np.integer) and abs(stated - value) <= tolerance):
            yield differs(f"{name}@rewards_{statistic}", stated, f"{value}")
