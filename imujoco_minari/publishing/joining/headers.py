"""Object headers: the messages that say what a group or a dataset is, and their attributes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import h5py
import numpy as np
from h5py import h5t
from numpy.typing import NDArray

from imujoco_minari.publishing.joining.records import (
    ATTRIBUTE,
    CONTINUATION,
    DATASPACE,
    HEADER,
    LAYOUT,
    MESSAGE_HEAD_SIZE,
    SYMBOL_TABLE,
    TEXT_REFERENCE,
    Positions,
    Reader,
    aligned,
    counting,
    require,
)

_NOTHING, _DATASPACE, _DATATYPE, _FILL, _LAYOUT = 0x00, 0x01, 0x03, 0x05, 0x08
_ATTRIBUTE, _CONTINUATION, _SYMBOL_TABLE, _MODIFIED = 0x0C, 0x10, 0x11, 0x12
_KNOWN = np.zeros(_MODIFIED + 1, bool)
_KNOWN[[_NOTHING, _DATASPACE, _DATATYPE, _FILL, _LAYOUT]] = True
_KNOWN[[_ATTRIBUTE, _CONTINUATION, _SYMBOL_TABLE, _MODIFIED]] = True
# The fill value that nobody has set: version 2, late, only if set, undefined.
_NO_FILL = np.frombuffer(bytes((2, 2, 2, 1, 0, 0, 0, 0)), "<i8")[0]
# An object of ours has two dozen; one that has many more is left to HDF5.
_MOST_MESSAGES, _MOST_DIMENSIONS = 256, 8


# Kinds of values: a text, or numbers.
NUMBERS = ("", "<i8", "<f8", "<f4", "|b1", "<f2", "<i4", "<i2", "|i1", "<u8", "<u4", "<u2", "|u1")
TEXT, INTEGER = 0, 1


@dataclass(frozen=True)
class Attributes:
    """Attributes of many objects: whose each is, where its value lies, and of which kind that is."""

    owner: Positions
    value: Positions
    name_at: Positions
    name_size: Positions
    kind: Positions
    scalar: NDArray[np.bool_]

    def named(self, reader: Reader, name: bytes, kind: int) -> Positions:
        """Return which of these are scalars of this name and kind."""
        some = (self.name_size == len(name) + 1) & (self.kind == kind) & self.scalar
        places = np.flatnonzero(some)
        named: Positions = places[reader.read(f"S{len(name)}", self.name_at[places]) == name]
        return named

    def texts(self) -> Positions:
        """Return where the file refers to the texts of those that are texts."""
        texts: Positions = self.value[self.kind == TEXT]
        return texts


@dataclass(frozen=True)
class Objects:
    """Many objects: which of them are groups, their tables of symbols, and all their attributes."""

    groups: Positions
    tables: NDArray[np.void]
    attributes: Attributes


class _Messages(NamedTuple):
    """Messages of many objects: whose each is, its type, and where and how long its content is."""

    owner: Positions
    type: Positions
    size: Positions
    at: Positions

    def of(self, kind: int) -> _Messages:
        some = self.type == kind
        return _Messages(*(part[some] for part in self))


@cache
def _encoded() -> list[bytes]:
    """Return the types of values that arrays and attributes may have here, as files state them."""
    # The two bytes before the type say that it is one.
    text = h5t.py_create(h5py.string_dtype(), logical=True).encode()[2:]
    numbers = [h5t.py_create(np.dtype(name), logical=True).encode()[2:] for name in NUMBERS[1:]]
    # A text takes more room where a file refers to it than a pointer to it in memory.
    return [text[:4] + TEXT_REFERENCE.itemsize.to_bytes(4, "little") + text[8:], *numbers]


def read_objects(reader: Reader, headers: Positions) -> Objects:
    """Read the objects whose headers are at these positions.

    Raises:
        NotPlainError: when one holds anything but what this package writes.
    """
    messages = _messages(reader, headers)
    require(messages.type < _KNOWN.size)
    require(_KNOWN[messages.type])
    modified = messages.of(_MODIFIED)
    require(modified.size == 8, reader.read("u1", modified.at) == 1)
    tables = messages.of(_SYMBOL_TABLE)
    require(tables.size >= SYMBOL_TABLE.itemsize)
    is_group = np.bincount(tables.owner, minlength=headers.size)
    _datasets(reader, messages, is_group)
    records = reader.read(SYMBOL_TABLE, tables.at)
    reader.address(tables.at, records["tree"])
    reader.address(tables.at + 8, records["heap"])
    return Objects(tables.owner, records, _attributes(reader, messages.of(_ATTRIBUTE)))


def _messages(reader: Reader, headers: Positions) -> _Messages:
    """Read all messages of all headers: those of first chunks, of second ones, and so on."""
    records = reader.read(HEADER, headers)
    require(records["version"] == 1, records["links"] == 1)
    owner, at, size = np.arange(headers.size), headers + HEADER.itemsize, records["size"].astype(np.int64)
    reader.take(headers, HEADER.itemsize + size)
    found: list[_Messages] = []
    left = records["messages"].astype(np.int64)
    while owner.size:
        messages = _of_chunks(reader, owner, at, at + size)
        found.append(messages)
        left -= np.bincount(messages.owner, minlength=left.size)
        require(left >= 0)
        more = messages.of(_CONTINUATION)
        require(more.size == CONTINUATION.itemsize)
        chunks = reader.read(CONTINUATION, more.at)
        owner, at, size = more.owner, chunks["address"], chunks["size"]
        reader.address(more.at, at)
        reader.take(at, size)
    require(left == 0)
    return _Messages(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _of_chunks(reader: Reader, owner: Positions, at: Positions, end: Positions) -> _Messages:
    """Read the messages of chunks, the first of each, the second of each, and so on."""
    found: list[tuple[Positions, Positions, Positions]] = []
    while owner.size:
        require(at < end, len(found) < _MOST_MESSAGES)
        # Type, size and flags in one number, which is three times as fast as a record.
        head = reader.read("<i8", at)
        found.append((owner, head, at))
        at = at + (((head >> 16) & 0xFFFF) + MESSAGE_HEAD_SIZE)
        on = at != end
        if not on.all():
            owner, at, end = owner[on], at[on], end[on]
    owner, head, at = (np.concatenate(parts) for parts in zip(*found, strict=True))
    require((head >> 32) & 0xFF <= 1)
    return _Messages(owner, head & 0xFFFF, (head >> 16) & 0xFFFF, at + MESSAGE_HEAD_SIZE)


def _datasets(reader: Reader, messages: _Messages, is_group: Positions) -> None:
    """Check that what is no group is a dataset whose array lies in one piece."""
    once = 1 - is_group
    parts = [messages.of(number) for number in (_DATASPACE, _DATATYPE, _LAYOUT, _FILL)]
    for part in parts:
        require(np.bincount(part.owner, minlength=once.size) == once)
    spaces, types, layouts, fills = parts
    require(fills.size == 8, reader.read("<i8", fills.at) == _NO_FILL)
    elements, _ = _elements(reader, spaces.at, spaces.size)
    kind, each = _kinds(reader, types.at, types.size)
    # An array of texts would have addresses in its data.
    require(kind != TEXT)
    sizes = np.zeros(once.size, np.int64)
    sizes[spaces.owner] = elements
    sizes[types.owner] *= each
    require(layouts.size >= LAYOUT.itemsize)
    records = reader.read(LAYOUT, layouts.at)
    require(records["version"] == 3, records["class"] == 1)
    require(records["size"] == sizes[layouts.owner])
    reader.address(layouts.at + 2, records["address"])
    there = records["address"] != -1
    reader.take(records["address"][there], records["size"][there])


def _attributes(reader: Reader, messages: _Messages) -> Attributes:
    records = reader.read(ATTRIBUTE, messages.at)
    require(records["version"] == 1, records["name_size"] > 0)
    name_at = messages.at + ATTRIBUTE.itemsize
    sizes, type_sizes, space_sizes = (
        records[f"{part}_size"].astype(np.int64) for part in ("name", "type", "space")
    )
    type_at = name_at + aligned(sizes)
    space_at = type_at + aligned(type_sizes)
    value = space_at + aligned(space_sizes)
    end = messages.at + messages.size
    require(value <= end)
    # HDF5 counts again, and stumbles over a name that ends before its end.
    names = reader.read("u1", np.repeat(name_at, sizes) + counting(sizes))
    require(np.array_equal(np.flatnonzero(names == 0), np.cumsum(sizes) - 1))
    kind, each = _kinds(reader, type_at, type_sizes)
    elements, scalar = _elements(reader, space_at, space_sizes)
    require(value + elements * each <= end)
    # One text has one address; an array of them is left to HDF5.
    require(scalar[kind == TEXT])
    return Attributes(messages.owner, value, name_at, sizes, kind, scalar)


def _elements(reader: Reader, at: Positions, sizes: Positions) -> tuple[Positions, NDArray[np.bool_]]:
    """Return how many elements each of these dataspaces has, and whether it is a scalar's."""
    records = reader.read(DATASPACE, at)
    rank, limits = records["rank"].astype(np.int64), records["flags"].astype(np.int64)
    require(records["version"] == 1, rank <= _MOST_DIMENSIONS, limits <= 1)
    require(DATASPACE.itemsize + 8 * rank * (1 + limits) <= sizes)
    elements = np.ones(at.size, np.int64)
    for dimension in range(int(rank.max(initial=0))):
        some = np.flatnonzero(rank > dimension)
        where = at[some] + DATASPACE.itemsize + 8 * dimension
        length = reader.read("<i8", where)
        # Where there are limits, an array has reached them: one that grows does not lie in one piece.
        limited = limits[some] == 1
        limit = reader.read("<i8", (where + 8 * rank[some])[limited])
        require(limit == length[limited])
        require(length >= 0, length <= reader.size)
        # In floating point, which does not wrap around.
        require(elements[some] * length.astype(np.float64) <= reader.size)
        elements[some] *= length
    return elements, rank == 0


def _kinds(reader: Reader, at: Positions, sizes: Positions) -> tuple[Positions, Positions]:
    """Return which of the known types each of these is, and how many bytes an element of it takes."""
    kind = np.full(at.size, -1)
    begin = reader.read("<i8", at)
    for number, known in enumerate(_encoded()):
        if (kind >= 0).all():
            break
        some = np.flatnonzero(begin == int.from_bytes(known[:8], "little"))
        if some.size:
            found = reader.read(f"V{len(known)}", at[some])
            same = (found.view(np.uint8).reshape(-1, len(known)) == np.frombuffer(known, np.uint8)).all(1)
            kind[some[same & (sizes[some] >= len(known))]] = number
    require(kind >= 0)
    # The second four bytes of a type are the size of an element.
    return kind, begin >> 32
