"""Transitions: gathered out of arrays, column by column, or out of packed rows, all columns at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.loading.load import Arrays, Transitions

Array = NDArray[Any]

# Rows that are packed at once, so that what one column wrote is still in the cache when the next comes.
_BLOCK = 4096
# Bytes that memory comes in. A row that begins with one touches fewer: an eighth less time.
_LINE = 64


@dataclass(frozen=True, eq=False)
class Packed:
    """Arrays' transitions, each in one piece of memory. Made by :func:`pack`.

    A batch drawn at random out of seven arrays waits for memory seven times a transition; out of packed
    rows, once.

    Attributes:
        rows: (N,) structured; a transition each, with the fields of
            :class:`~imujoco_minari.loading.load.Transitions`.
    """

    rows: Array

    def __len__(self) -> int:
        """The number of transitions."""
        return len(self.rows)

    def __getitem__(self, rows: Array | slice) -> Transitions:
        """Return transitions; their columns are views of one array."""
        if isinstance(rows, slice):
            drawn = self.rows[rows]
        else:
            # As plain bytes: NumPy copies structured elements field by field.
            pieces = self.rows.view(np.dtype((np.void, self.rows.itemsize)))
            drawn = np.take(pieces, rows).view(self.rows.dtype)
        return Transitions(*(drawn[name] for name in Transitions._fields))


def pack(data: Arrays) -> Packed:
    """Return a copy of the transitions for drawing many batches; whoever has it needs ``data`` no more."""
    columns = [np.asarray(getattr(data, name)) for name in Transitions._fields]
    rows = _rows(len(data), columns)
    for start in range(0, len(data), _BLOCK):
        block = slice(start, start + _BLOCK)
        for name, column in zip(Transitions._fields, columns, strict=True):
            rows[name][block] = column[block]
    return Packed(rows)


def _rows(count: int, columns: Sequence[Array]) -> Array:
    """Return room for so many rows of these columns, each of whole cache lines."""
    # Aligned within the row too: torch takes no column whose rows are not whole elements apart.
    fields: list[Any] = [
        (name, column.dtype, column.shape[1:])
        for name, column in zip(Transitions._fields, columns, strict=True)
    ]
    size = np.dtype(fields, align=True).itemsize
    row = np.dtype([*fields, ("padding", np.uint8, (-size % _LINE,))], align=True)
    room = np.empty(count * row.itemsize + _LINE, np.uint8)
    first = -room.ctypes.data % _LINE
    rows: Array = room[first : first + count * row.itemsize].view(row)
    return rows


def gather_transitions(data: Arrays | Packed, rows: Array | slice) -> Transitions:
    """Return the transitions of these rows; columns of packed ones lie side by side in memory."""
    if isinstance(data, Packed):
        return data[rows]
    if isinstance(rows, slice):
        return Transitions(*(getattr(data, name)[rows] for name in Transitions._fields))
    return Transitions(*(take(getattr(data, name), rows) for name in Transitions._fields))


def take(column: Array, rows: Array) -> Array:
    """Return rows of a column, in half the time that indexing takes."""
    return np.take(np.asarray(column), rows, axis=0)
