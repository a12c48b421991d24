"""Does the HDF5 file hold episodes, and nothing that is dangerous to read?

A file from outside may claim any shape, refer to other files, or hold groups within groups without
end. Everything here is looked at before it is read, and within bounds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from os.path import normpath
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from imujoco_minari import content, roots
from imujoco_minari.policies import SIZES
from imujoco_minari.verification.findings import Finding, same, shown

# An episode of 1000 steps of these robots has arrays of 136 kB at most.
MAX_ARRAY_BYTES = 2**26
MAX_ATTRIBUTE_BYTES = 2**20
MAX_ATTRIBUTES = 200
# Arrays and groups of one episode, and how deep they nest: Minari's own are six, infos are a group more.
MAX_OBJECTS, MAX_DEPTH = 100, 4
MAX_LINKS = 4

_KINDS = {"observations": "f", "actions": "f", "rewards": "f", "terminations": "b", "truncations": "b"}


def readable(file: h5py.File, data: Path) -> Iterator[Finding]:
    """Report what must not be read: links, odd types, claims without bounds.

    Args:
        file: the open HDF5 file.
        data: the folder in which it lies, or will lie.
    """
    expected = {f"episode_{i}" for i in range(len(file))}
    names = set(file)
    if not names:
        yield Finding(content.MAIN_FILE, "holds no episode")
    if names != expected:
        odd = sorted(names ^ expected)[0]
        yield Finding(content.MAIN_FILE, f"holds {shown(odd)} out of sequence")
        return
    yield from _attributes(file, "")
    for number in range(len(names)):
        name = f"episode_{number}"
        unreadable = _link(file, data, name) or _episode(file, name)
        if unreadable is not None:
            yield unreadable


def _link(file: h5py.File, data: Path, name: str, depth: int = 0) -> Finding | None:
    """Return what is wrong with how a file refers to an episode, in itself or in another dataset."""
    link = file.get(name, getlink=True)
    if isinstance(link, h5py.HardLink):
        return None
    if not isinstance(link, h5py.ExternalLink):
        return Finding(name, "is a soft link, which datasets do not have")
    source = Path(normpath(data / link.filename))
    root = Path(normpath(roots.datasets_root().absolute()))
    if not source.is_relative_to(root) or source.name != content.MAIN_FILE or depth >= MAX_LINKS:
        return Finding(name, f"refers to {shown(link.filename)}, which is no dataset of the Minari root")
    try:
        with h5py.File(source, "r") as other:
            target = str(link.path).strip("/")
            if "/" in target or target not in other:
                return Finding(name, f"refers to {shown(link.path)} of {source}, which is not there")
            return _link(other, source.parent, target, depth + 1)
    except OSError as error:
        return Finding(name, f"refers to {source}, which cannot be read: {str(error)[:120]}")


def _episode(file: h5py.File, name: str) -> Finding | None:
    group = file[name]
    if not isinstance(group, h5py.Group):
        return Finding(name, "is no group")
    objects = [0]
    return next(_objects(group, name, objects, 0), None)


def _objects(group: h5py.Group, where: str, seen: list[int], depth: int) -> Iterator[Finding]:
    """Report what is below a group, within bounds of depth and number; hard links may go in circles."""
    yield from _attributes(group, where)
    for key in group:
        place = f"{where}/{key}"
        seen[0] += 1
        if seen[0] > MAX_OBJECTS or depth >= MAX_DEPTH:
            yield Finding(where, f"holds more than {MAX_OBJECTS} arrays, or nests deeper than {MAX_DEPTH}")
            return
        if not isinstance(group.get(key, getlink=True), h5py.HardLink):
            yield Finding(place, "is a link to elsewhere, which an episode does not have")
            return
        item = group[key]
        if isinstance(item, h5py.Group):
            yield from _objects(item, place, seen, depth + 1)
        elif isinstance(item, h5py.Dataset):
            yield from _attributes(item, place)
            yield from _array(item, place)
        else:
            yield Finding(place, "is neither an array nor a group")


def _array(array: h5py.Dataset, where: str) -> Iterator[Finding]:
    properties = array.id.get_create_plist()
    if array.is_virtual or array.external:
        yield Finding(where, "takes its values from another file")
    elif array.dtype.kind not in "fiub":
        yield Finding(where, f"holds {array.dtype}, not numbers or flags")
    elif array.shape is None or array.nbytes > MAX_ARRAY_BYTES:
        yield Finding(where, f"claims more than {MAX_ARRAY_BYTES} bytes")
    elif properties.get_nfilters():
        yield Finding(where, "is compressed or filtered, as no dataset of ours is")
    elif array.id.get_storage_size() < array.nbytes:
        yield Finding(where, "claims more values than are stored")


def _attributes(item: Any, where: str) -> Iterator[Finding]:
    """Report attributes that are neither numbers nor short texts, before their values are read."""
    if len(item.attrs) > MAX_ATTRIBUTES:
        yield Finding(f"{where}@", f"has more than {MAX_ATTRIBUTES} attributes")
        return
    for key in item.attrs:
        attribute = item.attrs.get_id(key)
        count = int(np.prod(attribute.shape, dtype=object))
        text = h5py.check_string_dtype(attribute.dtype) is not None
        if not (text or attribute.dtype.kind in "fiub") or (text and attribute.shape != ()):
            yield Finding(f"{where}@{shown(key)[1:-1]}", "is neither a number nor a text")
        elif count * attribute.dtype.itemsize > MAX_ATTRIBUTE_BYTES:
            yield Finding(f"{where}@{shown(key)[1:-1]}", f"claims more than {MAX_ATTRIBUTE_BYTES} bytes")


def episodes(file: h5py.File, metadata: dict[str, Any]) -> Iterator[Finding]:
    """Report episodes whose arrays, flags and lengths do not fit, and totals that do not add up."""
    steps = 0
    for number in range(len(file)):
        name = f"episode_{number}"
        group = file[name]
        # A linked episode is its source's, number and all.
        linked = isinstance(file.get(name, getlink=True), h5py.ExternalLink)
        yield from _arrays(group, name, None if linked else number)
        rewards = group.get("rewards")
        steps += len(rewards) if isinstance(rewards, h5py.Dataset) and rewards.shape else 0
    for key, value in (("total_episodes", len(file)), ("total_steps", steps)):
        if not same(metadata.get(key), value):
            yield Finding(
                f"metadata.json/{key}", f"is {shown(metadata.get(key))}, but the file holds {value}"
            )


def _arrays(group: h5py.Group, name: str, number: int | None) -> Iterator[Finding]:
    # Every look at a group or an attribute by name goes through HDF5, so each is taken once.
    arrays = {key: group.get(key) for key in content.ARRAYS}
    missing = [key for key, array in arrays.items() if not isinstance(array, h5py.Dataset)]
    if missing:
        yield Finding(name, f"has no {missing[0]}")
        return
    attrs = dict(group.attrs)
    length = arrays["rewards"].shape[0] if arrays["rewards"].shape else 0
    if not length:
        yield Finding(name, "has no steps")
        return
    sizes = SIZES.get(str(attrs.get("robot")))
    shapes = {
        "observations": (length + 1, *arrays["observations"].shape[1:2]),
        "actions": (length, *arrays["actions"].shape[1:2]),
    }
    if sizes is not None:
        shapes = {"observations": (length + 1, sizes[0]), "actions": (length, sizes[1])}
    for key, array in arrays.items():
        expected = shapes.get(key, (length,))
        if array.shape != expected or array.dtype.kind != _KINDS[key]:
            yield Finding(
                f"{name}/{key}",
                f"holds {array.dtype} of shape {array.shape}, not "
                f"{'flags' if _KINDS[key] == 'b' else 'floats'} of shape {expected}",
            )
            return
    values = {key: array[()] for key, array in arrays.items()}
    yield from _flags(values, name)
    yield from _values(values, attrs, name, number)


def _flags(values: Mapping[str, Any], name: str) -> Iterator[Finding]:
    ends = values["terminations"] | values["truncations"]
    if ends[:-1].any():
        yield Finding(name, "goes on after a termination or truncation")
    if not ends[-1]:
        yield Finding(name, "ends without a termination or truncation")


def _values(
    values: Mapping[str, Any], attrs: Mapping[str, Any], name: str, number: int | None
) -> Iterator[Finding]:
    rewards = values["rewards"]
    length = len(rewards)
    if number is not None and not same(attrs.get("id"), number):
        yield Finding(f"{name}@id", f"is {shown(attrs.get('id'))}, not {number}")
    if not same(attrs.get("total_steps"), length):
        yield Finding(f"{name}@total_steps", f"is {shown(attrs.get('total_steps'))}, not {length}")
    seed = attrs.get("seed")
    replayable = "seed" in attrs or not same(attrs.get(content.REPLAYABLE), False)
    if replayable and (not isinstance(seed, np.integer) or not 0 <= seed < 2**63):
        yield Finding(f"{name}@seed", f"is {shown(seed)}, so the episode cannot be replayed")
    for key in ("observations", "actions", "rewards"):
        if not np.isfinite(values[key]).all():
            yield Finding(f"{name}/{key}", "holds values that are not finite")
            return
    for statistic in ("sum", "mean", "std", "max", "min"):
        stated, value = attrs.get(f"rewards_{statistic}"), float(getattr(rewards, statistic)())
        if not isinstance(stated, np.floating | np.integer) or not np.isclose(stated, value, rtol=1e-9):
            yield Finding(
                f"{name}@rewards_{statistic}", f"is {shown(stated)}, but the rewards' {statistic} is {value}"
            )
