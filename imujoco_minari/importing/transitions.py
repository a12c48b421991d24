"""Rows of steps from a file, cut into episodes and completed to what a Minari episode holds.

Files tell differently much: some mark every end, some only falls, some neither record what follows an
episode's last step nor the rewards. What a file lacks is simulated and said to be so; what it has is kept
as it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from minari.data_collector import EpisodeBuffer
from numpy.typing import NDArray

from imujoco_minari.envs.registration import MAX_EPISODE_STEPS
from imujoco_minari.errors import DatasetError
from imujoco_minari.importing.physics import Fidelity, Physics
from imujoco_minari.variants import specification

Array = NDArray[Any]

# Two simulators differ by far less in one step; a reset moves the robot by far more (m, rad).
_JUMP = 0.02
_FIDELITY_ROWS = 500


@dataclass(frozen=True)
class Transitions:
    """Steps in the order they were made, of several episodes one after the other.

    Attributes:
        observations: ``(n, observation size)``, float64.
        actions: ``(n, action size)``, float32.
        ends: ``(n,)``, whether the source marks the step as its episode's last.
        terminated: ``(n,)``, whether the source says that the step ended in a terminal state; None where
            it does not tell terminations from time limits.
        truncated: ``(n,)``, whether the source says that the step was the last by a time limit, or None.
        rewards: ``(n,)``, float64, or None.
        next_observations: like ``observations``, what followed each step, or None.
    """

    observations: Array
    actions: Array
    ends: Array
    terminated: Array | None = None
    truncated: Array | None = None
    rewards: Array | None = None
    next_observations: Array | None = None

    def __len__(self) -> int:
        return len(self.observations)


@dataclass(frozen=True)
class Cut:
    """Where the episodes of some transitions begin and end, and what had to be inferred.

    Attributes:
        bounds: first row, and row after the last, of each episode.
        simulate_final: whether the source lacks the observation after an episode's last step.
        notes: what the source did not say; each a sentence for the dataset's description.
    """

    bounds: tuple[tuple[int, int], ...]
    simulate_final: bool
    notes: tuple[str, ...]


def checked(transitions: Transitions, robot: str, name: str) -> Transitions:
    """Return the transitions in the dtypes of the robot's spaces.

    Raises:
        DatasetError: when they are none, not the robot's in shape, not finite, or no actions of the robot.
    """
    sizes, rows = specification(robot).sizes, len(transitions)
    if not rows:
        raise DatasetError(f"{name}: holds no steps")
    for what, array, shape in (
        ("observations", transitions.observations, (rows, sizes[0])),
        ("actions", transitions.actions, (rows, sizes[1])),
        ("rewards", transitions.rewards, (rows,)),
        ("next observations", transitions.next_observations, (rows, sizes[0])),
        ("ends", transitions.ends, (rows,)),
        ("terminations", transitions.terminated, (rows,)),
        ("truncations", transitions.truncated, (rows,)),
    ):
        if array is None:
            continue
        if array.shape != shape:
            raise DatasetError(f"{name}: {what} are of shape {array.shape}; {robot} needs {shape}")
        if not np.isfinite(array).all():
            raise DatasetError(f"{name}: {what} hold values that are not finite")
    if np.abs(transitions.actions).max() > 1.0 + 1e-6:
        raise DatasetError(
            f"{name}: actions reach {np.abs(transitions.actions).max():.6g}; "
            f"those of {robot} lie within -1 and 1"
        )
    return Transitions(
        transitions.observations.astype(np.float64),
        transitions.actions.astype(np.float32),
        transitions.ends.astype(bool),
        _cast(transitions.terminated, bool),
        _cast(transitions.truncated, bool),
        _cast(transitions.rewards, np.float64),
        _cast(transitions.next_observations, np.float64),
    )


def _cast(array: Array | None, dtype: Any) -> Array | None:
    return None if array is None else array.astype(dtype)


def cut(transitions: Transitions, physics: Physics) -> Cut:
    """Find the episodes: at marked ends, at resets that no mark announces, and at the time limit."""
    ends = transitions.ends.copy()
    unmarked = _unmarked_resets(transitions, physics)
    ends[unmarked] = True
    ends[-1] = True
    bounds, start, limited = [], 0, 0
    for last in np.flatnonzero(ends):
        while last + 1 - start > MAX_EPISODE_STEPS:
            bounds.append((start, start + MAX_EPISODE_STEPS))
            start += MAX_EPISODE_STEPS
            limited += 1
        bounds.append((start, int(last) + 1))
        start = int(last) + 1
    notes = []
    if len(unmarked):
        notes.append(f"{len(unmarked)} episodes end at a reset that the source does not mark.")
    if limited:
        notes.append(
            f"{limited} episodes end by the limit of {MAX_EPISODE_STEPS} steps, unmarked in the source."
        )
    if not transitions.ends[-1] and (bounds[-1][1] - bounds[-1][0]) < MAX_EPISODE_STEPS:
        notes.append("The last episode is cut where the source ends.")
    simulate_final = transitions.next_observations is None or _shows_resets(transitions, bounds)
    if simulate_final:
        notes.append(
            "The source has no observation after an episode's last step: "
            "the final observation of each episode is simulated from the one before it."
        )
    if transitions.rewards is None:
        notes.append(
            "The source has no rewards: they are simulated, step by step, from observation and action."
        )
    return Cut(tuple(bounds), simulate_final, tuple(notes))


def episodes(transitions: Transitions, cut: Cut, physics: Physics) -> Iterator[EpisodeBuffer]:
    """Yield the episodes as Minari stores them."""
    for start, stop in cut.bounds:
        observations, actions = transitions.observations[start:stop], transitions.actions[start:stop]
        final = (
            physics.step(observations[-1], actions[-1])[0]
            if cut.simulate_final or transitions.next_observations is None
            else transitions.next_observations[stop - 1]
        )
        rewards = (
            np.array([physics.step(o, a)[1] for o, a in zip(observations, actions, strict=True)])
            if transitions.rewards is None
            else transitions.rewards[start:stop]
        )
        terminations, truncations = np.zeros(stop - start, bool), np.zeros(stop - start, bool)
        terminations[-1] = _terminated(transitions, start, stop, final, physics)
        truncations[-1] = not terminations[-1] or _truncated(transitions, start, stop)
        yield EpisodeBuffer(
            observations=np.vstack([observations, final]),
            actions=actions,
            rewards=rewards,
            terminations=terminations,
            truncations=truncations,
        )


def fidelity(transitions: Transitions, cut: Cut, physics: Physics) -> Fidelity:
    """Compare evenly spaced steps of the transitions with the same steps simulated today."""
    inner = np.ones(len(transitions), bool)
    inner[[stop - 1 for _, stop in cut.bounds]] = False
    rows = np.flatnonzero(inner)
    rows = rows[:: max(1, len(rows) // _FIDELITY_ROWS)]
    return physics.fidelity(
        transitions.observations[rows],
        transitions.actions[rows],
        transitions.observations[rows + 1],
        None if transitions.rewards is None else transitions.rewards[rows],
    )


def _terminated(transitions: Transitions, start: int, stop: int, final: Array, physics: Physics) -> bool:
    """Return whether an episode ended in a terminal state: as the source says, else by the robot's rules."""
    if transitions.terminated is not None:
        return bool(transitions.terminated[stop - 1])
    if not transitions.ends[stop - 1] or not physics.can_terminate:
        return False
    # A mark before the time limit can only be a fall; at the limit it says nothing.
    return stop - start < MAX_EPISODE_STEPS or not physics.is_healthy(final)


def _truncated(transitions: Transitions, start: int, stop: int) -> bool:
    """Return whether an episode reached its time limit: as the source says, else by its length."""
    if transitions.truncated is not None:
        return bool(transitions.truncated[stop - 1])
    return stop - start == MAX_EPISODE_STEPS


def _shows_resets(transitions: Transitions, bounds: list[tuple[int, int]]) -> bool:
    """Return whether what follows an episode's last step is the reset of the next, as some loops record."""
    lasts = np.array([stop - 1 for _, stop in bounds[:-1]], dtype=int)
    if transitions.next_observations is None or not len(lasts):
        return False
    same = np.isclose(
        transitions.next_observations[lasts], transitions.observations[lasts + 1], rtol=1e-5, atol=1e-6
    )
    return bool(same.all(axis=1).mean() > 0.5)


def _unmarked_resets(transitions: Transitions, physics: Physics) -> Array:
    """Return the rows after which the robot is suddenly elsewhere, though no end is marked."""
    observations = transitions.observations
    inner = ~transitions.ends[:-1]
    if transitions.next_observations is not None:
        gaps = np.abs(transitions.next_observations[:-1] - observations[1:]).max(axis=1)
        return np.flatnonzero(inner & (gaps > _JUMP))
    reset = physics.looks_reset(observations)
    rows = np.flatnonzero(inner & reset[1:] & ~reset[:-1])
    return np.array(
        [row for row in rows.tolist() if _jumps(observations, transitions.actions, row, physics)], dtype=int
    )


def _jumps(observations: Array, actions: Array, row: int, physics: Physics) -> bool:
    simulated, _ = physics.step(observations[row], actions[row])
    return bool(np.abs(simulated - observations[row + 1])[: physics.positions].max() > _JUMP)
