"""Checks of arguments that several functions of this package take."""

from __future__ import annotations

from operator import index
from typing import Any

from imujoco_minari.errors import DatasetError, clipped


def whole_number(value: Any, name: str, *, least: int) -> int:
    """Return ``value`` as an ``int``.

    Args:
        value: the argument.
        name: its name, for the message.
        least: the smallest valid value.

    Raises:
        DatasetError: when ``value`` is not a whole number, or is smaller than ``least``.
    """
    try:
        number = index(value)
    except TypeError:
        number = least - 1
    if number < least:
        raise DatasetError(f"{name} must be a whole number of at least {least}, not {clipped(repr(value))}")
    return number
