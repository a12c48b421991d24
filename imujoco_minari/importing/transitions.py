"""Rows of steps from a file, cut into episodes that have everything that Minari stores.

Files differ. Some mark every end, some only falls, and some have no rewards or no final observations. Values
that a file lacks are simulated, and a note states this. Values that it has are kept as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from minari.data_collector import EpisodeBuffer
from numpy.typing import NDArray

from imujoco_minari.envs.registration import MAX_EPISODE_STEPS
from imujoco_minari.errors import DatasetError
from imujoco_minari.importing.physics import Physics
from imujoco_minari.variants import specification

Array = NDArray[Any]

# Two simulators differ by far less in one step; a reset moves the robot by far more (m, rad).
_JUMP = 0.02
_FIDELITY_ROWS = 500


class Quantity(NamedTuple):
    """How files name a quantity of each step.

    Attributes:
        column: its name as a column of a table; empty if a table has no such column.
        names: its names as an array of a file, D4RL's first.
        space: the space of its values, ``observation`` or ``action``; empty for one number.
    """

    column: str
    names: tuple[str, ...]
    space: str = ""

    def size(self, robot: str) -> int:
        """Return how many numbers a step of the robot has of it."""
        observation, action = specification(robot).sizes
        return {"observation": observation, "action": action}.get(self.space, 1)


# The fields of Transitions.
QUANTITIES = {
    "observations": Quantity("observation", ("observations", "observation", "obs", "states"), "observation"),
    "actions": Quantity("action", ("actions", "action", "acts", "act"), "action"),
    "rewards": Quantity("reward", ("rewards", "reward", "rews")),
    "next_observations": Quantity(
        "next_observation", ("next_observations", "next_obs", "next_states"), "observation"
    ),
    "terminations": Quantity("terminated", ("terminals", "terminations", "terminated")),
    "truncations": Quantity("", ("timeouts", "truncations", "truncated")),
    "ends": Quantity("done", ("dones", "done")),
}
_FLAGS = ("ends", "terminations", "truncations")


@dataclass(frozen=True)
class Transitions:
    """Steps in the order they were made, of several episodes one after the other.

    Attributes:
        observations: ``(n, observation size)``, float64.
        actions: ``(n, action size)``, float32.
        ends: ``(n,)``, whether the source marks the step as its episode's last.
        terminations: ``(n,)``, whether the source marks the step as a termination; None if it does not
            separate terminations from time limits.
        truncations: ``(n,)``, whether the source marks the step as the last by a time limit, or None.
        rewards: ``(n,)``, float64, or None.
        next_observations: like ``observations``, the observation after each step, or None.
    """

    observations: Array
    actions: Array
    ends: Array
    terminations: Array | None = None
    truncations: Array | None = None
    rewards: Array | None = None
    next_observations: Array | None = None

    def __len__(self) -> int:
        return len(np.atleast_1d(self.observations))

    def checked(self, robot: str, name: str) -> Transitions:
        """Return the transitions in the dtypes of the robot's spaces. ``name`` names the source in messages.

        Raises:
            DatasetError: when there are no steps, or a shape, a value or an action does not fit the robot.
        """
        if not len(self):
            raise DatasetError(f"{name}: holds no steps")
        cast: dict[str, Any] = {}
        for field, quantity in QUANTITIES.items():
            array, what = getattr(self, field), field.replace("_", " ")
            if array is None:
                continue
            shape = (len(self), quantity.size(robot)) if quantity.space else (len(self),)
            dtype = bool if field in _FLAGS else np.float32 if field == "actions" else np.float64
            if array.shape != shape:
                raise DatasetError(f"{name}: {what} are of shape {array.shape}; {robot} needs {shape}")
            if not np.isfinite(array).all():
                raise DatasetError(f"{name}: {what} hold values that are not finite")
            if dtype is bool and not np.isin(array, (0, 1)).all():
                raise DatasetError(f"{name}: {what} hold other numbers than 0 and 1")
            cast[field] = array.astype(dtype)
        largest = np.abs(self.actions).max()
        if largest > 1.0 + 1e-6:
            raise DatasetError(f"{name}: actions reach {largest:.6g}; those of {robot} lie within -1 and 1")
        return Transitions(**cast)


@dataclass(frozen=True)
class Fidelity:
    """The differences between recorded steps and the same steps simulated today.

    Each step has a largest deviation of a position (m, rad) and of a velocity (m/s, rad/s), and a deviation
    of the reward. The fields are the medians and maxima over ``rows`` steps, or None without such values.
    """

    rows: int
    position_median: float | None = None
    position_max: float | None = None
    velocity_median: float | None = None
    velocity_max: float | None = None
    reward_median: float | None = None
    reward_max: float | None = None


@dataclass(frozen=True)
class Cut:
    """Transitions, cut into episodes by :func:`cut`.

    Attributes:
        transitions: the transitions.
        physics: the simulator of their variant. It must be open.
        bounds: first row, and row after the last, of each episode.
        simulate_final: whether the source lacks the observation after an episode's last step.
        notes: what the source did not state; each a sentence for the dataset's description.
    """

    transitions: Transitions
    physics: Physics
    bounds: tuple[tuple[int, int], ...]
    simulate_final: bool
    notes: tuple[str, ...]

    def episodes(self) -> Iterator[EpisodeBuffer]:
        """Yield the episodes as Minari stores them."""
        steps, physics = self.transitions, self.physics
        for start, stop in self.bounds:
            observations, actions = steps.observations[start:stop], steps.actions[start:stop]
            if self.simulate_final or steps.next_observations is None:
                final = physics.step(observations[-1], actions[-1])[0]
            else:
                final = steps.next_observations[stop - 1]
            if steps.rewards is None:
                pairs = zip(observations, actions, strict=True)
                rewards = np.array([physics.step(*pair)[1] for pair in pairs])
            else:
                rewards = steps.rewards[start:stop]
            terminations, truncations = np.zeros(stop - start, bool), np.zeros(stop - start, bool)
            terminations[-1] = self._terminated(start, stop, final)
            truncations[-1] = not terminations[-1] or self._truncated(start, stop)
            yield EpisodeBuffer(
                observations=np.vstack([observations, final]),
                actions=actions,
                rewards=rewards,
                terminations=terminations,
                truncations=truncations,
            )

    def fidelity(self) -> Fidelity:
        """Compare evenly spaced steps of the transitions with the same steps simulated today."""
        steps, positions = self.transitions, self.physics.positions
        inner = np.ones(len(steps), bool)
        inner[[stop - 1 for _, stop in self.bounds]] = False
        rows = np.flatnonzero(inner)
        rows = rows[:: max(1, len(rows) // _FIDELITY_ROWS)]
        rows = rows[self.physics.is_whole(steps.observations[rows])]
        if not len(rows):
            return Fidelity(0)
        pairs = zip(steps.observations[rows], steps.actions[rows], strict=True)
        after, rewards = zip(*(self.physics.step(*pair) for pair in pairs), strict=True)
        errors = np.abs(np.array(after) - steps.observations[rows + 1])
        columns = [errors[:, :positions].max(axis=1), errors[:, positions:].max(axis=1)]
        if steps.rewards is not None:
            columns.append(np.abs(np.array(rewards) - steps.rewards[rows]))
        return Fidelity(len(rows), *(float(f(column)) for column in columns for f in (np.median, np.max)))

    def _terminated(self, start: int, stop: int, final: Array) -> bool:
        """Return whether an episode ended in a fall, by the source's flags or else by the robot's rules."""
        if self.transitions.terminations is not None:
            return bool(self.transitions.terminations[stop - 1])
        if not self.transitions.ends[stop - 1] or not self.physics.can_terminate:
            return False
        # A mark before the time limit must be a fall. A mark at the limit may be either.
        return stop - start < MAX_EPISODE_STEPS or not self.physics.is_healthy(final)

    def _truncated(self, start: int, stop: int) -> bool:
        """Return whether an episode reached its time limit, by the source's flags or else by its length."""
        if self.transitions.truncations is not None:
            return bool(self.transitions.truncations[stop - 1])
        return stop - start == MAX_EPISODE_STEPS


def cut(transitions: Transitions, physics: Physics) -> Cut:
    """Cut transitions into episodes: at marked ends, at resets without a mark, and at the time limit."""
    unmarked = _unmarked_resets(transitions, physics)
    ends = transitions.ends.copy()
    ends[unmarked] = ends[-1] = True
    bounds, start, limited = [], 0, 0
    for last in np.flatnonzero(ends).tolist():
        while last + 1 - start > MAX_EPISODE_STEPS:
            bounds.append((start, start + MAX_EPISODE_STEPS))
            start += MAX_EPISODE_STEPS
            limited += 1
        bounds.append((start, last + 1))
        start = last + 1
    simulate_final = transitions.next_observations is None or _shows_resets(transitions, bounds)
    (start, stop), cut_off = bounds[-1], not transitions.ends[-1]
    at_limit = (
        f"Episodes that end by the limit of {MAX_EPISODE_STEPS} steps, unmarked in the source: {limited}."
    )
    notes = {
        f"Episodes that end at a reset that the source does not mark: {len(unmarked)}.": len(unmarked),
        at_limit: limited,
        "The last episode is cut where the source ends.": cut_off and stop - start < MAX_EPISODE_STEPS,
        "The source has no observation after an episode's last step: "
        "the final observation of each episode is simulated from the one before it.": simulate_final,
        "The source has no rewards: they are simulated, step by step, from observation and action.": (
            transitions.rewards is None
        ),
    }
    true = tuple(note for note, holds in notes.items() if holds)
    return Cut(transitions, physics, tuple(bounds), simulate_final, true)


def _shows_resets(transitions: Transitions, bounds: list[tuple[int, int]]) -> bool:
    """Return whether most last steps are followed by the next reset's observation, as some loops record."""
    lasts = np.array([stop - 1 for _, stop in bounds[:-1]], dtype=int)
    if transitions.next_observations is None or not len(lasts):
        return False
    same = np.isclose(
        transitions.next_observations[lasts], transitions.observations[lasts + 1], rtol=1e-5, atol=1e-6
    )
    return bool(same.all(axis=1).mean() > 0.5)


def _unmarked_resets(transitions: Transitions, physics: Physics) -> Array:
    """Return the rows that have no mark, but after which the robot is suddenly in another state."""
    observations = transitions.observations
    inner = ~transitions.ends[:-1]
    if transitions.next_observations is not None:
        gaps = np.abs(transitions.next_observations[:-1] - observations[1:]).max(axis=1)
        return np.flatnonzero(inner & (gaps > _JUMP))
    reset = physics.looks_reset(observations)
    jumps = []
    for row in np.flatnonzero(inner & reset[1:] & ~reset[:-1]).tolist():
        simulated, _ = physics.step(observations[row], transitions.actions[row])
        if np.abs(simulated - observations[row + 1])[: physics.positions].max() > _JUMP:
            jumps.append(row)
    return np.array(jumps, dtype=int)
