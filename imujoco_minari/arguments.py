"""Checks of arguments that functions of several packages take."""

from __future__ import annotations

from collections.abc import Iterable
from operator import index
from pathlib import Path
from typing import Any

from imujoco_minari.errors import ArgumentError, DatasetError, clipped


def whole_number(value: Any, name: str, *, least: int) -> int:
    """Return ``value`` as an ``int``.

    Args:
        value: the argument.
        name: its name, for the message.
        least: the smallest valid value.

    Raises:
        ArgumentError: when ``value`` is not a whole number, or is smaller than ``least``.
    """
    try:
        number = index(value)
    except TypeError:
        number = least - 1
    if number < least or isinstance(value, bool):
        raise ArgumentError(f"{name} must be a whole number of at least {least}, not {clipped(repr(value))}")
    return number


def as_path(value: Any) -> Path:
    """Return a path.

    Raises:
        ArgumentError: when ``value`` is neither text nor a path.
    """
    try:
        return Path(value)
    except TypeError:
        raise ArgumentError(f"a path is text or a pathlib.Path, not {clipped(repr(value))}") from None


def check_one_robot(datasets: Iterable[tuple[str, str]], purpose: str) -> None:
    """Check that datasets are of one robot: robots with equal shapes still mean different things.

    Args:
        datasets: the robot of each dataset, empty where it is not known, and its id.
        purpose: the subject and the verb of the message, as in ``arrays hold``.

    Raises:
        DatasetError: when they are of several robots.
    """
    robots: dict[str, str] = {}
    for robot, dataset_id in datasets:
        robots.setdefault(robot or "unknown", dataset_id)
    if len(robots) > 1:
        listed = ", ".join(f"{robot} ({dataset_id})" for robot, dataset_id in robots.items())
        raise DatasetError(f"{purpose} one robot, but these datasets are of several: {listed}")
