"""The tasks of ODRL, a benchmark of off-dynamics learning, as variants: ``env_specs/odrl/``.

A task has a source, the unchanged robot with much data, and a target, a variant with little.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from imujoco_minari.errors import VariantError, clipped, suggestion, unknown
from imujoco_minari.short_repr import short_repr
from imujoco_minari.variants.ids import Variant
from imujoco_minari.variants.robots import pages_folder


@dataclass(frozen=True)
class OffDynamicsTask:
    """One task of off-dynamics learning.

    Attributes:
        name: as in ``hopper-friction-0.1``.
        source: the unchanged robot.
        target: the variant in which the policy is to act.
        note: what differs from ODRL's task of this name; empty where nothing is known to.
    """

    name: str
    source: Variant
    target: Variant
    note: str

    __repr__ = short_repr


def off_dynamics(name: str) -> OffDynamicsTask:
    """Return a task of ODRL.

    Args:
        name: robot, kind of shift and level, as in ``hopper-friction-0.1`` and
            ``walker2d-kinematic-footjnt-hard``.

    Raises:
        VariantError: if there is no such task, or ODRL's task is no variant; the message then says why.

    Example:
        >>> str(off_dynamics("hopper-friction-0.1").target)
        'hopper-frictiondec_90_feet'
    """
    robot, _, rest = name.partition("-")
    page = _pages().get(robot, {})
    for start, reason in page.get("not_expressed", {}).items():
        if rest.startswith(start):
            raise VariantError(f"ODRL's task {clipped(name)!r} is no variant: {reason}")
    names = off_dynamics_names()
    if name not in names:
        shown = clipped(name)
        raise VariantError(
            f"unknown task {shown!r}{suggestion(shown, names)}; "
            f"valid: {names[0]} and {len(names) - 1} others, see off_dynamics_names()"
        )
    notes = [note for start, note in page.get("notes", {}).items() if rest.startswith(start)]
    target = Variant.parse(f"{robot}-{page['tasks'][rest]}")
    return OffDynamicsTask(name, target.base, target, " ".join(notes))


def off_dynamics_names(robot: str | None = None) -> tuple[str, ...]:
    """Return the names of all tasks, or of those of one robot.

    Args:
        robot: one of ``hopper``, ``halfcheetah``, ``walker2d`` and ``ant``; None for all.

    Raises:
        VariantError: if no task has this robot.

    Example:
        >>> len(off_dynamics_names()), off_dynamics_names("hopper")[0]
        (71, 'hopper-friction-0.1')
    """
    pages = _pages()
    if robot is not None and robot not in pages:
        raise VariantError(unknown("no task of the robot", robot, pages))
    return tuple(f"{each}-{task}" for each in pages if robot in (None, each) for task in pages[each]["tasks"])


@cache
def _pages() -> Mapping[str, Mapping[str, Any]]:
    """Return robot -> its tasks (name -> changes), and notes and reasons by the beginnings of names."""
    files = sorted((pages_folder() / "odrl").glob("*.toml"))
    return {page.stem: tomllib.loads(page.read_text("utf-8")) for page in files}
