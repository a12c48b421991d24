"""The root group of a joined file, with a name for every episode.

HDF5 writes it, in memory, with names for an object that is nobody's; in the end each gets the address of
its episode instead. It lies behind the episodes, when all is known of them, but its place is known before.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np
from h5py import h5d, h5o, h5s, h5t

from imujoco_minari.publishing.joining.groups import read_names
from imujoco_minari.publishing.joining.layout import in_order, read_root
from imujoco_minari.publishing.joining.moving import Changes
from imujoco_minari.publishing.joining.records import (
    SUPERBLOCK,
    SYMBOL,
    NotPlainError,
    Positions,
    Reader,
    offset,
)
from imujoco_minari.publishing.joining.texts import read_texts

# What a handful of short attributes takes.
_ROOM = 2**13


class Root:
    """A root group in the making; closes with its ``with``.

    Attributes:
        size: how many bytes it takes in the end.
    """

    def __init__(self, episodes: int) -> None:
        """Make a root group with names for so many episodes."""
        self._file = h5py.File(
            "root", "w", driver="core", backing_store=False, libver=("earliest", "v108"), track_order=False
        )
        nobody = h5d.create(self._file.id, None, h5t.NATIVE_INT8, h5s.create(h5s.SCALAR))
        for number in range(episodes):
            h5o.link(nobody, self._file.id, b"episode_%d" % number)
        self._first = self._image()
        self.size = len(self._first) + _ROOM

    def __enter__(self) -> Root:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def superblock(self, base: int, end: int) -> bytes:
        """Return what a file begins with that has its root group at ``base``, and ends at ``end``."""
        (block,) = np.frombuffer(self._first, SUPERBLOCK, count=1).copy()
        for field in ("root", "tree", "heap"):
            block[field] += base
        block["end"] = end
        return bytes(block)

    def at(self, base: int, episodes: Positions, attributes: Mapping[str, Any]) -> bytes:
        """Return the root group as it is at ``base``, with attributes, and all episodes at their addresses.

        Raises:
            NotPlainError: when the attributes do not fit.
        """
        self._file.attrs.update(attributes)
        image = self._image()
        if len(image) > self.size:
            raise NotPlainError
        reader = Reader(image)
        root = read_root(reader)
        names = read_names(reader, root.tables)
        read_texts(reader, root.attributes.texts())
        addresses, values = reader.addresses()
        entries = names.entries_at[in_order(names.names)] + offset(SYMBOL, "header")
        rest = np.isin(addresses, entries, invert=True)
        changes = Changes.of(
            np.concatenate([addresses[rest], entries]), np.concatenate([values[rest] + base, episodes])
        )
        moved = bytearray(image)
        changes.make(memoryview(moved), 0)
        return bytes(moved.ljust(self.size, b"\0"))

    def _image(self) -> bytes:
        self._file.flush()
        image: bytes = self._file.id.get_file_image()
        return image
