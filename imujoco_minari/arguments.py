"""Checks of arguments that functions of several packages take."""

from __future__ import annotations

from operator import index
from typing import Any

from imujoco_minari.errors import ArgumentError, clipped


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
