"""Groups: the trees, tables and heaps that say which names are in them, and whose they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.publishing.joining.records import (
    FREE_BLOCK,
    LOCAL_HEAP,
    SYMBOL,
    SYMBOLS,
    TREE,
    Positions,
    Reader,
    counting,
    offset,
    require,
)

# How many children a node and how many names a table may have, by the superblock that is asked for.
INTERNAL_K, LEAF_K = 16, 4
_TREE_SIZE = TREE.itemsize + 8 * (2 * INTERNAL_K + 1) + 8 * 2 * INTERNAL_K
_TABLE_SIZE = SYMBOLS.itemsize + SYMBOL.itemsize * 2 * LEAF_K
_MOST_LEVELS, _LONGEST_NAME = 8, 255
_NO_FREE_BLOCK = 1


@dataclass(frozen=True)
class Names:
    """All names in some groups, and for each its entry, which says whose it is, and where that is."""

    names: NDArray[np.bytes_]
    entries: NDArray[np.void]
    entries_at: Positions


class _Leaves(NamedTuple):
    """Tables of symbols: in which group each is, and after which name its names come, up to which one."""

    group: Positions
    at: Positions
    after: Positions
    up_to: Positions


def read_names(reader: Reader, tables: NDArray[np.void]) -> Names:
    """Read the names in groups, and check that HDF5 would find each.

    Args:
        reader: of the file.
        tables: each group's ``tree`` and ``heap``.

    Raises:
        NotPlainError: when a structure is not as HDF5 writes it.
    """
    leaves = _leaves(reader, tables["tree"])
    records = reader.read(SYMBOLS, leaves.at)
    require(records["signature"].view("S4") == b"SNOD", records["version"] == 1)
    used = records["used"].astype(np.int64)
    require(used > 0, used <= 2 * LEAF_K)
    reader.take(leaves.at, _TABLE_SIZE)
    group = np.repeat(leaves.group, used)
    at = np.repeat(leaves.at + SYMBOLS.itemsize, used) + SYMBOL.itemsize * counting(used)
    entries = reader.read(SYMBOL, at)
    reader.address(at + offset(SYMBOL, "header"), entries["header"])
    # What is cached of a group is checked with the group. Links to names have no address.
    require(entries["cache"] <= 1)
    cached = entries["cache"] == 1
    for field in ("tree", "heap"):
        reader.address(at[cached] + offset(SYMBOL, field), entries[field][cached])
    heaps = _Heaps(reader, tables["heap"])
    names = heaps.texts(group, entries["name"])
    require(names != b"", names != b".", not (np.char.find(names, b"/") >= 0).any())
    require((names[:-1] < names[1:]) | (group[:-1] != group[1:]))
    last = np.cumsum(used) - 1
    require(heaps.texts(leaves.group, leaves.after) < names[last + 1 - used])
    require(names[last] <= heaps.texts(leaves.group, leaves.up_to))
    return Names(names, entries, at)


def _leaves(reader: Reader, roots: Positions) -> _Leaves:
    """Return the tables of symbols in these trees, those of a group in the order of their names."""
    group, nodes = np.arange(roots.size), roots
    levels = reader.read(TREE, roots)["level"].astype(np.int64)
    require(levels < _MOST_LEVELS)
    after = up_to = None
    found: list[_Leaves] = []
    while nodes.size:
        records = reader.read(TREE, nodes)
        require(records["signature"].view("S4") == b"TREE", records["type"] == 0)
        require(records["level"] == levels)
        used = records["used"].astype(np.int64)
        require(used <= 2 * INTERNAL_K)
        reader.take(nodes, _TREE_SIZE)
        for field in ("left", "right"):
            reader.address(nodes + offset(TREE, field), records[field])
        # Keys and children take turns; there is one key more.
        keys = nodes + TREE.itemsize
        if after is not None:
            require(reader.read("<i8", keys) == after)
            require(reader.read("<i8", keys + 16 * used) == up_to)
        key = np.repeat(keys, used) + 16 * counting(used)
        children = reader.read("<i8", key + 8)
        reader.address(key + 8, children)
        group, levels = np.repeat(group, used), np.repeat(levels, used) - 1
        after, up_to = reader.read("<i8", key), reader.read("<i8", key + 16)
        leaf, on = levels < 0, levels >= 0
        found.append(_Leaves(group[leaf], children[leaf], after[leaf], up_to[leaf]))
        group, nodes, levels, after, up_to = group[on], children[on], levels[on], after[on], up_to[on]
    return _Leaves(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


class _Heaps:
    """Where groups keep their names."""

    def __init__(self, reader: Reader, heaps: Positions) -> None:
        records = reader.read(LOCAL_HEAP, heaps)
        require(records["signature"].view("S4") == b"HEAP", records["version"] == 0)
        self._sizes, segments, free = records["size"], records["segment"], records["free"]
        reader.take(heaps, LOCAL_HEAP.itemsize)
        reader.take(segments, self._sizes)
        reader.address(heaps + offset(LOCAL_HEAP, "segment"), segments)
        # Only what was taken without overlap is in bounds, and small enough to be looked at byte by byte.
        reader.check_taken()
        # A chain of free blocks that bites its tail would keep HDF5 busy for ever: one block, or none.
        some = np.flatnonzero(free != _NO_FREE_BLOCK)
        require(free[some] >= 0, free[some] <= self._sizes[some] - FREE_BLOCK.itemsize)
        blocks = reader.read(FREE_BLOCK, segments[some] + free[some])
        require(blocks["next"] == _NO_FREE_BLOCK, blocks["size"] >= FREE_BLOCK.itemsize)
        require(blocks["size"] <= self._sizes[some] - free[some])
        # Names end before what is free, which is last.
        require(free[some] + blocks["size"] == self._sizes[some])
        self._used = np.where(free == _NO_FREE_BLOCK, self._sizes, free)
        self._begin = np.cumsum(self._sizes) - self._sizes
        self._bytes = reader.read("u1", np.repeat(segments, self._sizes) + counting(self._sizes))
        self._ends = np.flatnonzero(self._bytes == 0)

    def texts(self, group: Positions, offsets: Positions) -> NDArray[np.bytes_]:
        """Return the texts at offsets in the heaps of groups.

        Raises:
            NotPlainError: when one does not end, or is longer than names are.
        """
        require(offsets >= 0, offsets < self._used[group])
        begin = self._begin[group] + offsets
        place = np.searchsorted(self._ends, begin)
        require(place < self._ends.size)
        end = self._ends[place]
        require(end < self._begin[group] + self._used[group])
        width = int((end - begin).max(initial=0)) + 1
        require(width <= _LONGEST_NAME)
        at = np.minimum(begin[:, None] + np.arange(width), end[:, None])
        texts: NDArray[np.bytes_] = self._bytes[at].view(f"S{width}").ravel()
        return texts
