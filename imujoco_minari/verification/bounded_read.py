"""Checks every part of an HDF5 file before it is read: its kind, its size and where its values are.

A file from outside may claim any shape, refer to other files, or hold groups within groups without
end. An episode that passes is handed on as an :class:`Episode`, so that each object is opened once: by
h5py's low-level interface, which takes a fifth of the time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from imujoco_minari.errors import DatasetError
from imujoco_minari.storage import containment, file_format
from imujoco_minari.verification.findings import Finding, shown

# An episode of 1000 steps of these robots has arrays of 136 kB at most.
MAX_ARRAY_BYTES = 2**26
MAX_ATTRIBUTE_BYTES = 2**20
MAX_ATTRIBUTES = 200
# Arrays and groups of one episode, and how deep they nest: Minari's own are six, infos are a group more.
MAX_OBJECTS, MAX_DEPTH = 100, 4

_TEXT = h5py.string_dtype()


class UnreadableError(Exception):
    """Something in a file must not be read; the finding says what and why."""

    def __init__(self, where: str, what: str) -> None:
        super().__init__(where, what)
        self.finding = Finding(where, what)


@dataclass(frozen=True)
class ReadableArray:
    """An array below an episode that may be read: its HDF5 dataset and its attributes."""

    dataset: h5py.h5d.DatasetID
    attributes: Mapping[str, Any]

    @property
    def shape(self) -> tuple[int, ...]:
        """The array's shape."""
        return tuple(self.dataset.shape)

    @property
    def dtype(self) -> np.dtype[Any]:
        """The array's type."""
        dtype: np.dtype[Any] = self.dataset.dtype
        return dtype

    def read(self) -> Any:
        """Return the array's values."""
        values = np.empty(self.shape, self.dtype)
        if values.size:
            self.dataset.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
        return values


@dataclass(frozen=True)
class Episode:
    """An episode that may be read.

    Attributes:
        name: of its group, ``episode_<number>``.
        linked: it lies in another file, and its number is that of its source.
        attributes: of its group.
        arrays: by their path below the group.
    """

    name: str
    linked: bool
    attributes: Mapping[str, Any]
    arrays: dict[str, ReadableArray] = field(default_factory=dict)


def check_names(file: h5py.File) -> None:
    """Raise an :class:`UnreadableError` unless a file holds episodes, all of them, and nothing else."""
    found, expected = set(file), {f"episode_{number}" for number in range(len(file))}
    if not found:
        raise UnreadableError(file_format.MAIN_FILE, "holds no episode")
    if found != expected:
        odd = sorted(found ^ expected)[0]
        raise UnreadableError(file_format.MAIN_FILE, f"holds {shown(odd)} out of sequence")


def look(file: h5py.File, data: Path, number: int) -> Episode:
    """Return an episode of an open file that lies, or will lie, in the folder ``data``.

    Raises:
        UnreadableError: for links, odd types, and claims without bounds.
    """
    name = f"episode_{number}"
    link = file.get(name, getlink=True)
    linked = not isinstance(link, h5py.HardLink)
    if linked:
        _follow(file, data, name)
    group = file[name].id
    if not isinstance(group, h5py.h5g.GroupID):
        raise UnreadableError(name, "is no group")
    episode = Episode(name, linked, attributes(group, name))
    _look_below(group, name, "", episode.arrays, [0])
    return episode


def attributes(item: Any, where: str) -> dict[str, Any]:
    """Return the attributes of an HDF5 object, given by its low-level identifier.

    Raises:
        UnreadableError: when there are too many, or one is neither a number nor a short text.
    """
    count = h5py.h5a.get_num_attrs(item)
    if count > MAX_ATTRIBUTES:
        raise UnreadableError(f"{where}@", f"has more than {MAX_ATTRIBUTES} attributes")
    found: dict[str, Any] = {}
    for index in range(count):
        attribute = h5py.h5a.open(item, index=index)
        key = attribute.name.decode("utf-8", "surrogateescape")
        place = f"{where}@{shown(key)[1:-1]}"
        shape, kind = attribute.shape, attribute.get_type()
        text = isinstance(kind, h5py.h5t.TypeStringID)
        dtype = _TEXT if text and kind.is_variable_str() else kind.dtype
        if not (text or dtype.kind in "fiub") or (text and shape != ()):
            raise UnreadableError(place, "is neither a number nor a text")
        if math.prod(shape) * dtype.itemsize > MAX_ATTRIBUTE_BYTES:
            raise UnreadableError(place, f"claims more than {MAX_ATTRIBUTE_BYTES} bytes")
        values = np.empty(shape, dtype)
        attribute.read(values)
        value = values[()]
        found[key] = value.decode("utf-8", "surrogateescape") if isinstance(value, bytes) else value
    return found


def _follow(file: h5py.File, data: Path, name: str) -> None:
    """Raise for a link that does not lead to an episode of another dataset of the Minari root."""
    with ExitStack() as stack:

        def opened(path: Path) -> h5py.File:
            return stack.enter_context(h5py.File(path, "r"))

        try:
            holder, target = containment.follow(file, name.encode(), data, opened)
            if target not in holder.id:
                raise UnreadableError(name, f"refers to {shown(target)}, which does not exist")
        except DatasetError as error:
            raise UnreadableError(name, str(error)) from None
        except (OSError, KeyError) as error:
            raise UnreadableError(name, f"refers to what cannot be read: {str(error)[:120]}") from None


def _look_below(
    group: Any, where: str, prefix: str, arrays: dict[str, ReadableArray], seen: list[int]
) -> None:
    """Add the arrays below a group, within bounds of depth and number; hard links may go in circles."""
    for raw in group:
        key = raw.decode("utf-8", "surrogateescape")
        place = f"{where}/{key}"
        seen[0] += 1
        if seen[0] > MAX_OBJECTS or prefix.count("/") >= MAX_DEPTH:
            raise UnreadableError(
                where, f"holds more than {MAX_OBJECTS} arrays, or nests deeper than {MAX_DEPTH}"
            )
        if group.links.get_info(raw).type != h5py.h5l.TYPE_HARD:
            raise UnreadableError(place, "is a link to elsewhere, which an episode does not have")
        item = h5py.h5o.open(group, raw)
        if isinstance(item, h5py.h5g.GroupID):
            attributes(item, place)
            _look_below(item, place, f"{prefix}{key}/", arrays, seen)
        elif isinstance(item, h5py.h5d.DatasetID):
            found = ReadableArray(item, attributes(item, place))
            _look_at(item, place)
            arrays[f"{prefix}{key}"] = found
        else:
            raise UnreadableError(place, "is neither an array nor a group")


def _look_at(array: Any, where: str) -> None:
    properties, shape, dtype = array.get_create_plist(), array.shape, array.dtype
    try:
        containment.check_array(array, where)
    except DatasetError:
        raise UnreadableError(where, "takes its values from another file") from None
    if dtype.kind not in "fiub":
        raise UnreadableError(where, f"holds {dtype}, not numbers or flags")
    if array.get_space().get_simple_extent_type() == h5py.h5s.NULL:
        raise UnreadableError(where, "holds nothing")
    size = math.prod(shape) * dtype.itemsize
    if size > MAX_ARRAY_BYTES:
        raise UnreadableError(where, f"claims more than {MAX_ARRAY_BYTES} bytes")
    if properties.get_nfilters():
        raise UnreadableError(where, "is compressed or filtered, as no dataset of ours is")
    if array.get_storage_size() < size:
        raise UnreadableError(where, "claims more values than are stored")
