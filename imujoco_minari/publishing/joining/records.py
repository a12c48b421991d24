"""Records of HDF5's file format, read many at a time and never beyond the end of the file.

Source: the HDF5 File Format Specification, version 3.0, of the superblock of version 0 and of what goes
with it. Every number is little-endian; an address that is not there is all ones, -1 here.
"""

from __future__ import annotations

import mmap
from typing import Any

import numpy as np
from numpy.typing import NDArray

Positions = NDArray[np.int64]

SUPERBLOCK = np.dtype(
    [
        ("signature", "V8"),
        ("versions", "V8"),
        ("leaf_k", "<u2"),
        ("internal_k", "<u2"),
        ("flags", "<u4"),
        ("base", "<i8"),
        ("free_space", "<i8"),
        ("end", "<i8"),
        ("driver", "<i8"),
        ("root_name", "<i8"),
        ("root", "<i8"),
        ("cache", "<u4"),
        ("reserved", "<u4"),
        ("tree", "<i8"),
        ("heap", "<i8"),
    ]
)
HEADER = np.dtype(
    [
        ("version", "u1"),
        ("reserved", "u1"),
        ("messages", "<u2"),
        ("links", "<u4"),
        ("size", "<u4"),
        ("pad", "<u4"),
    ]
)
# Type and size, two bytes each, flags, and three bytes that say nothing.
MESSAGE_HEAD_SIZE = 8
CONTINUATION = np.dtype([("address", "<i8"), ("size", "<i8")])
SYMBOL_TABLE = np.dtype([("tree", "<i8"), ("heap", "<i8")])
TREE = np.dtype(
    [
        ("signature", "V4"),
        ("type", "u1"),
        ("level", "u1"),
        ("used", "<u2"),
        ("left", "<i8"),
        ("right", "<i8"),
    ]
)
SYMBOLS = np.dtype([("signature", "V4"), ("version", "u1"), ("reserved", "u1"), ("used", "<u2")])
SYMBOL = np.dtype(
    [
        ("name", "<i8"),
        ("header", "<i8"),
        ("cache", "<u4"),
        ("reserved", "<u4"),
        ("tree", "<i8"),
        ("heap", "<i8"),
    ]
)
LOCAL_HEAP = np.dtype(
    [
        ("signature", "V4"),
        ("version", "u1"),
        ("reserved", "V3"),
        ("size", "<i8"),
        ("free", "<i8"),
        ("segment", "<i8"),
    ]
)
FREE_BLOCK = np.dtype([("next", "<i8"), ("size", "<i8")])
GLOBAL_HEAP = np.dtype([("signature", "V4"), ("version", "u1"), ("reserved", "V3"), ("size", "<i8")])
DATASPACE = np.dtype([("version", "u1"), ("rank", "u1"), ("flags", "u1"), ("reserved", "V5")])
LAYOUT = np.dtype([("version", "u1"), ("class", "u1"), ("address", "<i8"), ("size", "<i8")])
ATTRIBUTE = np.dtype(
    [
        ("version", "u1"),
        ("reserved", "u1"),
        ("name_size", "<u2"),
        ("type_size", "<u2"),
        ("space_size", "<u2"),
    ]
)
TEXT_REFERENCE = np.dtype([("length", "<u4"), ("address", "<i8"), ("index", "<u4")])
ADDRESS = np.dtype("<i8")


_all = np.logical_and.reduce


class NotPlainError(Exception):
    """A file that is not of the kind whose every byte of structure is known here."""


class Reader:
    """The bytes of a file, with a note of which of them are taken by what, and of where addresses are."""

    def __init__(self, data: mmap.mmap | bytes) -> None:
        self._data = data
        self.size = len(data)
        self._every: dict[Any, NDArray[Any]] = {}
        self._taken: list[tuple[Positions, Positions]] = []
        self._addresses: list[tuple[Positions, Positions]] = []

    def read(self, record: np.dtype[Any] | str, at: Positions) -> NDArray[Any]:
        """Return the records at these positions.

        Raises:
            NotPlainError: when one of them is not within the file.
        """
        every = self._every.get(record)
        if every is None:
            # Records begin anywhere: one at every byte, of which some are taken.
            dtype = np.dtype(record)
            every = np.ndarray(max(0, self.size - dtype.itemsize + 1), dtype, self._data, strides=(1,))
            self._every[record] = every
        # Without a sign what is negative is too large as well.
        require(at.size == 0 or bool(at.view(np.uint64).max() < every.size))
        # A copy: nothing may refer to the file once it is closed.
        return every[at]

    def bytes(self, at: int, size: int) -> bytes:
        """Return the bytes of something that was taken."""
        return self._data[at : at + size]

    def take(self, at: Positions, sizes: Positions | int) -> None:
        """Note what lies at these positions, and that nothing else may."""
        self._taken.append((at, np.broadcast_to(np.asarray(sizes, np.int64), at.shape)))

    def address(self, at: Positions, values: Positions) -> None:
        """Note that at these positions there are these addresses, or none."""
        there = values != -1
        self._addresses.append((at[there], values[there]))

    def check_taken(self) -> None:
        """Raise a NotPlainError when two things overlap, or one is not within the file."""
        at, sizes = (np.concatenate(parts) for parts in zip(*self._taken, strict=True))
        order = np.argsort(at, kind="stable")
        begin, end = at[order], (at + sizes)[order]
        require(sizes >= 0, int(begin[0]) >= 0, int(end.max()) <= self.size)
        require(begin[1:] >= end[:-1])

    def addresses(self) -> tuple[Positions, Positions]:
        """Return where all the addresses are, and the addresses."""
        at, values = (np.concatenate(parts) for parts in zip(*self._addresses, strict=True))
        return at, values


def counting(sizes: Positions) -> Positions:
    """Return 0, 1, 2, ... up to each size, one after the other."""
    return np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes)


def aligned(size: Any) -> Any:
    """Return a size, or many, rounded up to what HDF5 pads to: eight bytes."""
    return (size + 7) & ~7


def offset(record: np.dtype[np.void], field: str) -> int:
    """Return where in a record a field begins."""
    assert record.fields is not None
    return int(record.fields[field][1])


def require(*conditions: bool | np.bool_ | NDArray[np.bool_]) -> None:
    """Raise a NotPlainError unless all of them are true, and true for all."""
    for condition in conditions:
        # Not their method all(), which is Python and takes longer than what it calls.
        if not (_all(condition) if isinstance(condition, np.ndarray) else condition):
            raise NotPlainError
