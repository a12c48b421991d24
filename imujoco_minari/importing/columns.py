"""Which column of an archive's table is what: guessed, and the guess checked against the robot's rules.

The original documents only that a row begins with observation and action, and its reader takes the last
column for the done flag. The columns between them are found by trial: a reward must follow the robot's
reward formula, and a next observation must be the next row's observation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.envs.registration import MAX_EPISODE_STEPS
from imujoco_minari.errors import DatasetError, suggestion
from imujoco_minari.importing.transitions import Transitions, checked
from imujoco_minari.variants import specification

Array = NDArray[Any]

# The one array of the original's npz files.
ARRAY = "data"

_COLUMNS = ("observation", "action", "reward", "next_observation", "done", "terminated", "skip")
_EXAMPLE = "observation,action,reward,done"


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

    def of(self, table: Array, name: str) -> Array | None:
        """Return the columns of ``table`` that go by ``name``, ``(n,)`` where it is one number."""
        start = 0
        for column, size in self.columns:
            if column == name:
                found = table[:, start : start + size]
                return found if name.endswith(("observation", "action")) else found[:, 0]
            start += size
        return None


@dataclass(frozen=True)
class Check:
    """One thing that must hold if a layout is right: what, whether it does, and what was seen."""

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
            raise DatasetError(
                f"unknown column {name!r}{suggestion(name, _COLUMNS)}; valid: {', '.join(_COLUMNS)}"
            )
        if name != "skip" and (count or name in dict(columns)):
            raise DatasetError(
                f"column {word!r}: only skip takes a number, as in skip:3, and only skip may repeat"
            )
        if name == "skip" and count and not (count.isascii() and count.isdigit() and 0 < int(count) < 1000):
            raise DatasetError(f"column {word!r}: valid: skip, or skip:<how many>")
        columns.append((name, int(count or 1) if name == "skip" else _size(name, robot)))
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
        robot: whose observations and actions they hold.
        name: what to call the table in messages.
        columns: the layout where the user states it; None to detect it.

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
        # The user's statement is believed, unless the column of flags holds other numbers.
        if not checks[0].passed:
            raise DatasetError(f"{name}: {checks[0]}")
    return checked(_transitions(table, found), robot, name), found, checks


def _detect(table: Array, robot: str, name: str) -> tuple[Layout, list[Check]]:
    known = sum(specification(robot).sizes)
    between = table.shape[1] - known - 1
    candidates = [
        layout(",".join(("observation", "action", *middle, "done")), robot)
        for middle in (
            (),
            ("reward",),
            ("next_observation",),
            ("reward", "next_observation"),
            ("next_observation", "reward"),
        )
        if sum(_size(column, robot) for column in middle) == between
    ]
    tried = [(candidate, _checks(table, candidate, robot)) for candidate in candidates]
    fitting = [(candidate, checks) for candidate, checks in tried if all(check.passed for check in checks)]
    if len(fitting) == 1:
        return fitting[0]
    head = f"{name}: has {table.shape[1]} columns, {known} of them {robot}'s observation and action"
    if not candidates:
        found = f"the {max(between + 1, 0)} others are not reward, next observation and done"
    else:
        found = "; ".join(f"as {candidate} ({_failed(checks)})" for candidate, checks in tried)
    raise DatasetError(f"{head}; {found}. State them with --columns, for example --columns {_EXAMPLE}")


def _failed(checks: list[Check]) -> str:
    return ", ".join(str(check) for check in checks if not check.passed) or "all checks pass"


def _checks(table: Array, candidate: Layout, robot: str) -> list[Check]:
    rows = _transitions(table, candidate)
    checks = [_check_done(candidate.of(table, "done")), _check_actions(rows.actions)]
    if rows.next_observations is not None:
        checks.append(_check_next(rows))
    if rows.rewards is not None and specification(robot).reward is not None:
        checks.append(_check_reward(rows, robot))
    return checks


def _check_done(done: Array | None) -> Check:
    assert done is not None
    odd = done[(done != 0) & (done != 1)]
    seen = f"it holds {odd[0]:.6g}" if len(odd) else f"{int(done.sum())} of {len(done)} are 1"
    return Check("the done column is 0 or 1", not len(odd), seen)


def _check_actions(actions: Array) -> Check:
    largest = float(np.abs(actions).max())
    return Check("actions lie within -1 and 1", largest <= 1.0 + 1e-6, f"the largest is {largest:.6g}")


def _check_next(rows: Transitions) -> Check:
    assert rows.next_observations is not None
    inner = _inner(rows)
    gaps = np.abs(rows.next_observations[:-1] - rows.observations[1:])
    same = (gaps <= 1e-6 + 1e-5 * np.abs(rows.observations[1:])).all(axis=1)[inner]
    share = float(same.mean()) if len(same) else 0.0
    return Check(
        "the next observation is the next row's", share >= 0.98, f"in {share:.1%} of {len(same)} rows"
    )


def _check_reward(rows: Transitions, robot: str) -> Check:
    """Compare with the formula; the velocity over a step lies near the mean of those at its ends."""
    assert rows.rewards is not None
    page = specification(robot)
    assert page.reward is not None, "called for robots with a formula only"
    cost, healthy = page.reward.control_cost, page.reward.healthy
    inner = np.flatnonzero(_inner(rows))
    velocity = rows.observations[:, page.observed_positions].astype(np.float64)
    expected = (velocity[inner] + velocity[inner + 1]) / 2
    given = (
        rows.rewards[inner] + cost * np.square(rows.actions[inner].astype(np.float64)).sum(axis=1) - healthy
    )
    if not len(given):
        return Check(
            "the reward follows the robot's formula", False, "no two rows of one episode to tell it by"
        )
    error = float(np.median(np.abs(given - expected)))
    spread = float(np.median(np.abs(expected - np.median(expected))))
    return Check(
        "the reward follows the robot's formula",
        error <= 0.5 * spread + 0.02,
        f"median difference {error:.3g} where the forward velocity spreads by {spread:.3g}",
    )


def _inner(rows: Transitions) -> Array:
    """Return which rows, but for the last, are followed by the next of the same episode."""
    inner = ~rows.ends[:-1].astype(bool)
    # Some files mark falls only, and begin a new episode every 1000 rows.
    inner[MAX_EPISODE_STEPS - 1 :: MAX_EPISODE_STEPS] = False
    return inner


def _transitions(table: Array, found: Layout) -> Transitions:
    get: Callable[[str], Any] = lambda name: found.of(table, name)  # noqa: E731
    return Transitions(
        get("observation"),
        get("action"),
        get("done"),
        get("terminated"),
        None,
        get("reward"),
        get("next_observation"),
    )


def _size(name: str, robot: str) -> int:
    observation, action = specification(robot).sizes
    return action if name == "action" else observation if name.endswith("observation") else 1
