"""The layout of a dataset's file: where its episodes are, and where it says where anything is.

What is read here is all that HDF5 would read of it but the numbers in the arrays. So a file that has a
layout holds no surprise for it: nothing overlaps, nothing points outside, nothing goes round in circles.
"""

from __future__ import annotations

import mmap
from dataclasses import dataclass
from io import FileIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.publishing.joining.groups import INTERNAL_K, LEAF_K, read_names
from imujoco_minari.publishing.joining.headers import (
    INTEGER,
    NUMBERS,
    TEXT,
    Attributes,
    Objects,
    read_objects,
)
from imujoco_minari.publishing.joining.records import SUPERBLOCK, NotPlainError, Positions, Reader, require
from imujoco_minari.publishing.joining.texts import Texts, read_texts
from imujoco_minari.storage import file_format

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
# All versions are 0; addresses and sizes have eight bytes.
_VERSIONS = bytes((0, 0, 0, 0, 0, 8, 8, 0))
_DEEPEST = 8
_DIGEST_LENGTH = 64


@dataclass(frozen=True)
class Layout:
    """Where things are in the file of a dataset of ``E`` episodes.

    Attributes:
        addresses: where in the file its addresses are.
        values: those addresses.
        episodes: where each episode's object header is; shape ``(E,)``.
        ids: where the number of each episode is, its attribute ``id``; shape ``(E,)``.
        steps: how many steps the episodes have together.
        digests: the digest of each episode.
        attributes: of the root group, those that are one value.
    """

    addresses: Positions
    values: Positions
    episodes: Positions
    ids: Positions
    steps: int
    digests: list[str]
    attributes: dict[str, Any]


def read_layout(file: FileIO) -> Layout:
    """Return the layout of a dataset's file.

    Raises:
        NotPlainError: when it is not as this package writes files.
        OSError: when the file cannot be read.
    """
    try:
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError):
        # An empty file, or a file system that maps none into memory, as some in the cloud.
        raise NotPlainError from None
    with data:
        return _layout(Reader(data))


def read_root(reader: Reader) -> Objects:
    """Return a file's root group.

    Raises:
        NotPlainError: when the file is of a version other than that which is written here.
    """
    start = np.zeros(1, np.int64)
    blocks = reader.read(SUPERBLOCK, start)
    reader.take(start, SUPERBLOCK.itemsize)
    (block,) = blocks
    require(block["signature"].tobytes() == _SIGNATURE, block["versions"].tobytes() == _VERSIONS)
    require(block["leaf_k"] == LEAF_K, block["internal_k"] == INTERNAL_K, block["flags"] == 0)
    require(block["base"] == 0, block["free_space"] == -1, block["driver"] == -1)
    require(block["end"] == reader.size, block["root_name"] == 0)
    root = read_objects(reader, blocks["root"])
    require(root.groups.size == 1)
    _check_cached(blocks, root)
    return root


def in_order(names: NDArray[np.bytes_]) -> Positions:
    """Return which of the names is which episode's, when they are those of all episodes and no others."""
    places = {name: place for place, name in enumerate(names.tolist())}
    try:
        order = [places[b"episode_%d" % number] for number in range(names.size)]
    except KeyError:
        raise NotPlainError from None
    return np.array(order, np.int64)


def _layout(reader: Reader) -> Layout:
    root = read_root(reader)
    names = read_names(reader, root.tables)
    order = in_order(names.names)
    headers = names.entries["header"]
    episodes = read_objects(reader, headers)
    require(episodes.groups.size == headers.size > 0)
    _check_cached(names.entries, episodes)
    text_at = [root.attributes.texts(), episodes.attributes.texts()]

    below = episodes
    for _ in range(_DEEPEST):
        if not below.groups.size:
            break
        inside = read_names(reader, below.tables)
        below = read_objects(reader, inside.entries["header"])
        _check_cached(inside.entries, below)
        text_at.append(below.attributes.texts())
    require(not below.groups.size)

    ids, steps, digests = (
        _of_each(reader, episodes.attributes, headers.size, name, kind)[order]
        for name, kind in ((b"id", INTEGER), (b"total_steps", INTEGER), (file_format.DIGEST.encode(), TEXT))
    )
    # Where an episode is from must be said; what is said may be anything.
    _of_each(reader, episodes.attributes, headers.size, b"source", TEXT)
    texts = read_texts(reader, np.concatenate(text_at))
    where, lengths = texts.of(digests)
    require(lengths == _DIGEST_LENGTH)
    reader.check_taken()
    addresses, values = reader.addresses()
    return Layout(
        addresses=addresses,
        values=values,
        episodes=headers[order],
        ids=ids,
        steps=int(reader.read("<i8", steps).sum()),
        digests=[_text(reader, at, _DIGEST_LENGTH) for at in where.tolist()],
        attributes=_values(reader, root.attributes, texts),
    )


def _of_each(reader: Reader, attributes: Attributes, count: int, name: bytes, kind: int) -> Positions:
    """Return where the value of an attribute is that each of so many objects has once."""
    some = attributes.named(reader, name, kind)
    require(np.bincount(attributes.owner[some], minlength=count) == 1)
    at = np.empty(count, np.int64)
    at[attributes.owner[some]] = attributes.value[some]
    return at


def _values(reader: Reader, attributes: Attributes, texts: Texts) -> dict[str, Any]:
    """Return the attributes of one object that are one value, as h5py would."""
    values: dict[str, Any] = {}
    for place in np.flatnonzero(attributes.scalar).tolist():
        name = _text(reader, int(attributes.name_at[place]), int(attributes.name_size[place]) - 1)
        at, kind = attributes.value[place : place + 1], int(attributes.kind[place])
        if kind == TEXT:
            (where,), (length,) = texts.of(at)
            values[name] = _text(reader, int(where), int(length)) if length else ""
        else:
            values[name] = reader.read(NUMBERS[kind], at)[0]
    return values


def _text(reader: Reader, at: int, length: int) -> str:
    return reader.bytes(at, length).decode("utf-8", "surrogateescape")


def _check_cached(entries: NDArray[np.void], objects: Objects) -> None:
    """Check that what entries say of the groups that they are of is what those say themselves."""
    tables = np.full((2, entries.size), -1)
    tables[:, objects.groups] = objects.tables["tree"], objects.tables["heap"]
    cached = entries["cache"] == 1
    for field, said in zip(("tree", "heap"), tables, strict=True):
        require(entries[field][cached] == said[cached])
