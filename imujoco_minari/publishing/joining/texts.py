"""Texts: the heaps where the file keeps them, and the places that refer to them."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from imujoco_minari.publishing.joining.records import (
    GLOBAL_HEAP,
    TEXT_REFERENCE,
    NotPlainError,
    Positions,
    Reader,
    aligned,
    offset,
    require,
)

_OBJECT = struct.Struct("<H6xq")


@dataclass(frozen=True)
class Texts:
    """Where the file refers to texts, in order, and where each is and how long; one that is none is at -1."""

    referred_at: Positions
    at: Positions
    lengths: Positions

    def of(self, referred_at: Positions) -> tuple[Positions, Positions]:
        """Return where the texts are that these places refer to, and how long each is."""
        found = np.searchsorted(self.referred_at, referred_at)
        return self.at[found], self.lengths[found]


def read_texts(reader: Reader, referred_at: Positions) -> Texts:
    """Find all texts of a file, given the places that refer to them.

    Raises:
        NotPlainError: when a text is not there as a whole.
    """
    referred_at = np.sort(referred_at)
    records = reader.read(TEXT_REFERENCE, referred_at)
    lengths, address = records["length"].astype(np.int64), records["address"]
    some = address != 0
    require(lengths[~some] == 0)
    reader.address(referred_at[some] + offset(TEXT_REFERENCE, "address"), address[some])
    heaps, number = np.unique(address[some], return_inverse=True)
    keys, places, sizes = _objects(reader, heaps)
    # One number for that of a heap and that of an object in it, which has four bytes at most.
    wanted = (number << 32) + records["index"][some].astype(np.int64)
    require(keys.size > 0 or not wanted.size)
    found = np.minimum(np.searchsorted(keys, wanted), keys.size - 1)
    require(keys[found] == wanted, lengths[some] == sizes[found])
    at = np.full(address.size, -1)
    at[some] = places[found]
    return Texts(referred_at, at, lengths)


def _objects(reader: Reader, heaps: Positions) -> tuple[Positions, Positions, Positions]:
    """Return number of heap and object, place and size of all objects in these heaps, in order."""
    records = reader.read(GLOBAL_HEAP, heaps)
    require(records["signature"].view("S4") == b"GCOL", records["version"] == 1)
    reader.take(heaps, records["size"])
    reader.check_taken()
    # Few heaps with many objects, one after the other: no work for arrays.
    found: list[int] = []
    for number, (heap, size) in enumerate(zip(heaps.tolist(), records["size"].tolist(), strict=True)):
        content, at = reader.bytes(heap, size), GLOBAL_HEAP.itemsize
        while at + _OBJECT.size <= size:
            index, length = _OBJECT.unpack_from(content, at)
            if index == 0:
                # What is free: all the rest, its own head included.
                require(length == size - at)
                break
            at += _OBJECT.size
            if not 0 <= length <= size - at:
                raise NotPlainError
            found += (number << 32) + index, heap + at, length
            at += aligned(length)
    keys, places, lengths = np.array(found, np.int64).reshape(-1, 3).T
    order = np.argsort(keys)
    require(np.diff(keys[order]) > 0)
    return keys[order], places[order], lengths[order]
