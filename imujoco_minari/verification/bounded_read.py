"""Checks every part of an HDF5 file before it is read: its kind, its size and where its values are.

A file from outside may claim any shape, or refer to other files. An episode that passes is handed on as an
:class:`Episode`, so that each object is opened once: by h5py's low-level interface, which takes a fifth of
the time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np

from imujoco_minari.errors import DatasetError
from imujoco_minari.storage import containment, file_format
from imujoco_minari.storage.containment import LinkedFiles
from imujoco_minari.verification.findings import shown

# An episode of 1000 steps of these robots has arrays of 136 kB at most.
MAX_ARRAY_BYTES = 2**26
MAX_ATTRIBUTE_BYTES = 2**20
MAX_ATTRIBUTES = 200
# Arrays of one episode: this package writes five.
MAX_ARRAYS = 100

_TEXT = h5py.string_dtype()


class UnreadableError(Exception):
    """Something in a file must not be read; the arguments are those of a finding."""


@dataclass(frozen=True)
class ReadableArray:
    """An array below an episode that may be read: its HDF5 dataset, shape, type and attributes."""

    dataset: h5py.h5d.DatasetID
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    attributes: Mapping[str, Any]

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
        linked: whether it is in another file, and so has its number in that file.
        attributes: of its group.
        arrays: by name.
    """

    name: str
    linked: bool
    attributes: Mapping[str, Any]
    arrays: Mapping[str, ReadableArray]


def check_names(file: h5py.File) -> None:
    """Raise an :class:`UnreadableError` unless a file holds episodes, all of them, and nothing else."""
    found, expected = set(file), set(map(file_format.episode_name, range(len(file))))
    if not found:
        raise UnreadableError(file_format.MAIN_FILE, "holds no episode")
    if found != expected:
        odd = sorted(found ^ expected)[0]
        raise UnreadableError(file_format.MAIN_FILE, f"holds {shown(odd)} out of sequence")


def look(files: LinkedFiles, number: int) -> Episode:
    """Return an episode of a dataset.

    Raises:
        UnreadableError: for links, odd types, and claims without bounds.
    """
    name = file_format.episode_name(number)
    try:
        holder, place = files.find(number)
        group = h5py.h5o.open(holder.id, place)
    except DatasetError as error:
        raise UnreadableError(name, str(error)) from None
    except KeyError as error:
        missing = error.args[0].decode("utf-8", "replace")
        raise UnreadableError(
            name, f"refers to {missing[:80]} of another dataset, which has no such episode"
        ) from None
    except OSError as error:
        raise UnreadableError(name, f"refers to a file that cannot be opened: {str(error)[:120]}") from None
    if not isinstance(group, h5py.h5g.GroupID):
        raise UnreadableError(name, "is no group")
    if len(group) > MAX_ARRAYS:
        raise UnreadableError(name, f"holds more than {MAX_ARRAYS} arrays")
    return Episode(name, holder is not files.file, attributes(group, name), _arrays(group, name))


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


def _arrays(group: Any, where: str) -> dict[str, ReadableArray]:
    """Return the arrays of an episode. Beside them it may hold an empty group of infos, and nothing else."""
    try:
        containment.check_links(group, "")
    except DatasetError as error:
        raise UnreadableError(where, str(error)) from None
    found = {}
    for raw in group:
        key = raw.decode("utf-8", "surrogateescape")
        place = f"{where}/{key}"
        try:
            array = h5py.h5o.open(group, raw)
            if key == file_format.INFOS and _is_empty_group(array):
                continue
            if not isinstance(array, h5py.h5d.DatasetID):
                raise UnreadableError(place, "is no array")
            containment.check_array(array, place)
        except DatasetError as error:
            raise UnreadableError(place, str(error).removeprefix(f"{place} ")) from None
        _check_size(array, place)
        found[key] = ReadableArray(array, array.shape, array.dtype, attributes(array, place))
    return found


def _is_empty_group(item: Any) -> bool:
    return isinstance(item, h5py.h5g.GroupID) and not len(item) and not h5py.h5a.get_num_attrs(item)


def _check_size(array: Any, where: str) -> None:
    dtype, size = array.dtype, math.prod(array.shape) * array.dtype.itemsize
    if dtype.kind not in "fiub":
        raise UnreadableError(where, f"holds {dtype}, not numbers or flags")
    if array.get_space().get_simple_extent_type() == h5py.h5s.NULL:
        raise UnreadableError(where, "holds nothing")
    if size > MAX_ARRAY_BYTES:
        raise UnreadableError(where, f"claims more than {MAX_ARRAY_BYTES} bytes")
    if array.get_create_plist().get_nfilters():
        raise UnreadableError(where, "is compressed or filtered, as no dataset of ours is")
    if array.get_storage_size() < size:
        raise UnreadableError(where, "claims more values than are stored")
