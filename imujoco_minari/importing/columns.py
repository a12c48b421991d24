"""The meaning of each column of a table: possible layouts are tried, and checked against the robot's rules.

The original documents only that a row begins with observation and action. Its reader takes the last column
as the done flag. Checks find the columns between them: a reward must follow the robot's reward formula, and a
next observation must be the next row's observation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.envs.registration import MAX_EPISODE_STEPS
from imujoco_minari.errors import DatasetError, unknown
from imujoco_minari.exporting.flat import ARCHIVE_TABLE, TABLE
from imujoco_minari.importing.transitions import QUANTITIES, Transitions
from imujoco_minari.variants import specification
from imujoco_minari.variants.pages import Reward

Array = NDArray[Any]

# The one array of the original's npz files.
ARRAY = "data"

# The name of a column, and the field of Transitions that it becomes.
_FIELDS = {quantity.column: field for field, quantity in QUANTITIES.items() if quantity.column}
_COLUMNS = (*_FIELDS, "skip")
_EXAMPLE = "observation,action,reward,done"
# The layouts that are tried. This package exports the last two.
_KNOWN = (
    ("observation", "action", "done"),
    ("observation", "action", "reward", "done"),
    ("observation", "action", "next_observation", "done"),
    ("observation", "action", "next_observation", "reward", "done"),
    TABLE,
    ARCHIVE_TABLE,
)


@dataclass(frozen=True)
class Layout:
    """The columns of a table in order: name and how many numbers; built by :func:`layout`."""

    columns: tuple[tuple[str, int], ...]

    @property
    def width(self) -> int:
        """How many numbers a row has."""
        return sum(size for _, size in self.columns)

    def __str__(self) -> str:
        return ",".join(f"skip:{size}" if name == "skip" else name for name, size in self.columns)

    def transitions(self, table: Array) -> Transitions:
        """Return the columns of ``table`` as they are, unchecked."""
        fields: dict[str, Array] = {}
        start = 0
        for name, size in self.columns:
            found = table[:, start : start + size]
            start += size
            if name in _FIELDS:
                field = _FIELDS[name]
                fields[field] = found if QUANTITIES[field].space else found[:, 0]
        return Transitions(**fields)


@dataclass(frozen=True)
class Check:
    """A condition that a right layout meets, whether it is met, and what was found."""

    what: str
    passed: bool
    seen: str

    def __str__(self) -> str:
        return f"{self.what}: {'yes' if self.passed else 'no'}, {self.seen}"


def layout(text: str, robot: str) -> Layout:
    """Return the layout that ``text`` names, as in ``observation,action,skip:2,reward,done``.

    Raises:
        DatasetError: when it is malformed, or observation, action or done is missing.
    """
    columns: list[tuple[str, int]] = []
    for word in text.replace(" ", "").split(","):
        name, _, count = word.partition(":")
        if name not in _COLUMNS:
            raise DatasetError(unknown("unknown column", name, _COLUMNS))
        if name != "skip" and (count or name in dict(columns)):
            raise DatasetError(
                f"column {word!r}: only skip takes a number, as in skip:3, and only skip may repeat"
            )
        if name == "skip" and count and not (count.isascii() and count.isdigit() and 0 < int(count) < 1000):
            raise DatasetError(f"column {word!r}: valid: skip, or skip:<how many>")
        columns.append((name, int(count or 1) if name == "skip" else QUANTITIES[_FIELDS[name]].size(robot)))
    missing = [name for name in ("observation", "action", "done") if name not in dict(columns)]
    if missing:
        raise DatasetError(f"the columns need {missing[0]}; for example {_EXAMPLE}")
    return Layout(tuple(columns))


def read_table(
    table: Array, robot: str, name: str, columns: str | None = None
) -> tuple[Transitions, Layout, list[Check]]:
    """Return the transitions of a table, the layout by which they were read, and its checks.

    Args:
        table: rows of numbers.
        robot: the robot that the observations and actions belong to.
        name: the name of the table in messages.
        columns: the layout, if the user states it; None to detect it.

    Raises:
        DatasetError: when no layout, or more than one, fits; or the stated one does not fit the table.
    """
    if table.ndim != 2 or not len(table):
        raise DatasetError(f"{name}: is of shape {table.shape}, not rows of columns")
    if columns is None:
        found, checks = _detect(table, robot, name)
    else:
        found = layout(columns, robot)
        if found.width != table.shape[1]:
            raise DatasetError(
                f"{name}: has {table.shape[1]} columns, but {columns} makes {found.width} for {robot}"
            )
        checks = _checks(table, found, robot)
        # The layout that the user states is used, unless the done column holds other numbers than 0 and 1.
        if not checks[0].passed:
            raise DatasetError(f"{name}: {checks[0]}")
    return found.transitions(table).checked(robot, name), found, checks


def _detect(table: Array, robot: str, name: str) -> tuple[Layout, list[Check]]:
    candidates = [layout(",".join(known), robot) for known in _KNOWN]
    tried = [(each, _checks(table, each, robot)) for each in candidates if each.width == table.shape[1]]
    fitting = [(candidate, checks) for candidate, checks in tried if all(check.passed for check in checks)]
    if len(fitting) == 1:
        return fitting[0]
    known = sum(specification(robot).sizes)
    head = f"{name}: has {table.shape[1]} columns, {known} of them {robot}'s observation and action"
    if tried:
        found = "; ".join(f"as {candidate} ({_failed(checks)})" for candidate, checks in tried)
    else:
        others = max(table.shape[1] - known, 0)
        found = f"the {others} others are not reward, next observation and done"
    raise DatasetError(f"{head}; {found}. State them with --columns, for example --columns {_EXAMPLE}")


def _failed(checks: list[Check]) -> str:
    return ", ".join(str(check) for check in checks if not check.passed) or "all checks pass"


def _checks(table: Array, candidate: Layout, robot: str) -> list[Check]:
    rows = candidate.transitions(table)
    checks = [_check_done(rows.ends), _check_actions(rows.actions)]
    if rows.next_observations is not None:
        checks.append(_check_next(rows, rows.next_observations))
    formula = specification(robot).reward
    if rows.rewards is not None and formula is not None:
        checks.append(_check_reward(rows, rows.rewards, robot, formula))
    if rows.terminations is not None:
        checks.append(_check_terminated(rows.ends, rows.terminations))
    return checks


def _check_done(done: Array) -> Check:
    odd = done[(done != 0) & (done != 1)]
    seen = f"it holds {odd[0]:.6g}" if len(odd) else f"{int(done.sum())} of {len(done)} are 1"
    return Check("the done column is 0 or 1", not len(odd), seen)


def _check_actions(actions: Array) -> Check:
    largest = float(np.abs(actions).max())
    return Check("actions lie within -1 and 1", largest <= 1.0 + 1e-6, f"the largest is {largest:.6g}")


def _check_next(rows: Transitions, next_observations: Array) -> Check:
    gaps = np.abs(next_observations[:-1] - rows.observations[1:])
    same = (gaps <= 1e-6 + 1e-5 * np.abs(rows.observations[1:])).all(axis=1)[_inner(rows)]
    share = float(same.mean()) if len(same) else 0.0
    return Check(
        "the next observation is the next row's", share >= 0.98, f"in {share:.1%} of {len(same)} rows"
    )


def _check_reward(rows: Transitions, rewards: Array, robot: str, formula: Reward) -> Check:
    """Compare with the formula. The velocity over a step is near the mean of those before and after it."""
    what = "the reward follows the robot's formula"
    inner = np.flatnonzero(_inner(rows))
    if not len(inner):
        return Check(what, False, "no two rows of one episode to tell it by")
    velocity = rows.observations[:, specification(robot).observed_positions].astype(np.float64)
    expected = (velocity[inner] + velocity[inner + 1]) / 2
    effort = np.square(rows.actions[inner].astype(np.float64)).sum(axis=1)
    given = rewards[inner] + formula.control_cost * effort - formula.healthy
    error = float(np.median(np.abs(given - expected)))
    typical = float(np.median(expected))
    spread = float(np.median(np.abs(expected - typical)))
    seen = f"median difference {error:.3g} where the forward velocity is {typical:.3g} ± {spread:.3g}"
    # A fast and steady robot's velocity changes more within a step than from step to step.
    return Check(what, error <= max(0.5 * spread, 0.03 * abs(typical)) + 0.02, seen)


def _check_terminated(done: Array, terminated: Array) -> Check:
    """Check that every early end is marked, few ends at the time limit, and no other row."""
    lasts = np.flatnonzero(done)
    early = np.diff(lasts, prepend=-1) < MAX_EPISODE_STEPS
    at_limit = terminated[lasts[~early]]
    passed = (
        np.isin(terminated, (0, 1)).all()
        and terminated.sum() == terminated[lasts].sum()
        and terminated[lasts[early]].all()
        and 2 * at_limit.sum() <= len(at_limit)
    )
    seen = f"{early.sum()} of {len(lasts)} episodes end early, {(terminated == 1).sum()} rows are marked"
    return Check("terminated marks the episodes that end early", bool(passed), seen)


def _inner(rows: Transitions) -> Array:
    """Return which rows have their successor in the next row. The last row of the table is not included."""
    inner = ~rows.ends[:-1].astype(bool)
    # Some files mark only falls, and begin a new episode after 1000 rows.
    inner[MAX_EPISODE_STEPS - 1 :: MAX_EPISODE_STEPS] = False
    return inner
