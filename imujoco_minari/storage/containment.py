"""A dataset takes its values from its own file, or by links from other datasets of the Minari root.

HDF5 would follow links and "external storage" to any file of the reader's machine. Every reader of this
package checks an episode here first.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from os import fsdecode
from os.path import normpath
from pathlib import Path
from typing import Any

import h5py
from h5py import h5d, h5g, h5l, h5o

from imujoco_minari.errors import DatasetError
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.storage.transactions import STAGING

MAX_LINKS, _MAX_DEPTH = 4, 4


def linked_file(data: Path, filename: str) -> Path | None:
    """Return the file that a link in a dataset leads to, or None if it is no dataset of the same root.

    For a staged dataset, the staging folder stands for the root, so its links are checked as they will be.

    Args:
        data: the ``data`` folder of the dataset.
        filename: the path in the link.
    """
    data = Path(normpath(data.absolute()))
    root = Path(normpath(minari_root.datasets_root()))
    if not data.is_relative_to(root):
        root = root.resolve()
    staging = root / STAGING
    if data.is_relative_to(staging):
        root = staging / data.relative_to(staging).parts[0]
    path = Path(normpath(data / filename))
    outside = not path.is_relative_to(root) or STAGING in path.relative_to(root).parts
    return None if outside or path.name != file_format.MAIN_FILE else path


# For the folder and the file name of a link: the open file, and the folder of that file.
Followed = dict[tuple[Path, bytes], tuple[Any, Path]]


def follow(
    file: Any, name: bytes, data: Path, opened: Callable[[Path], Any], followed: Followed, depth: int = 0
) -> tuple[Any, bytes]:
    """Return the file that holds an episode, and the episode's name in it.

    Args:
        file: the dataset's file, open.
        name: the name of the episode in it.
        data: the ``data`` folder of the dataset.
        opened: opens another dataset's file.
        followed: the files that earlier links led to. New ones are added.
        depth: number of links that were followed before.

    Raises:
        DatasetError: if the episode is a link that leads out of the root, or through too many files.
        KeyError: if there is no such episode.
    """
    links, where = file.id.links, fsdecode(name)
    kind = _kind(file.id, name)
    if kind == h5l.TYPE_HARD:
        return file, name
    if kind != h5l.TYPE_EXTERNAL:
        raise DatasetError(f"{file.filename}: {where} is a soft link, which datasets do not have")
    filename, target = links.get_val(name)
    target = target.strip(b"/")
    link = data, filename
    if link not in followed and (path := linked_file(data, fsdecode(filename))) is not None:
        # A staged dataset may be a link to the folder of one in the root.
        folder = path.parent.resolve() if path.parent.parent.is_symlink() else path.parent
        followed[link] = opened(path), folder
    if link not in followed or b"/" in target or depth >= MAX_LINKS:
        raise DatasetError(
            f"{file.filename}: {where} refers to {fsdecode(filename)[:80]!r}, "
            "which is no dataset of the Minari root"
        )
    other, folder = followed[link]
    return follow(other, target, folder, opened, followed, depth + 1)


def _kind(group: h5g.GroupID, name: bytes) -> int:
    try:
        kind: int = group.links.get_info(name).type
    except RuntimeError:
        raise KeyError(name) from None
    return kind


def check_array(array: h5d.DatasetID, where: str) -> None:
    """Raise a DatasetError if an array takes its values from another file."""
    if array.get_offset() is not None:
        # One block of this file.
        return
    properties = array.get_create_plist()
    if properties.get_layout() == h5d.VIRTUAL or properties.get_external_count():
        raise DatasetError(f"{where} takes its values from another file; do not use the dataset")


def check_links(group: h5g.GroupID, where: str) -> None:
    """Raise a DatasetError that begins with ``where`` if an episode holds a link to elsewhere."""
    found: list[bytes] = []

    def look(name: bytes, link: Any) -> bool:
        if link.type != h5l.TYPE_HARD:
            found.append(name)
        return bool(found)

    # One call for all links of the group, instead of one for each.
    group.links.iterate(look, info=True)
    if found:
        raise DatasetError(
            f"{where}{fsdecode(found[0])} is a link to elsewhere, which an episode does not have"
        )


def check_episode(file: h5py.File, number: int, data: Path) -> None:
    """Check that an episode takes all its values from datasets of the Minari root.

    Args:
        file: the dataset's file, open.
        number: of the episode.
        data: the ``data`` folder of the dataset.

    Raises:
        DatasetError: if it does not.
        KeyError: if there is no such episode.
    """
    with ExitStack() as stack:

        def opened(path: Path) -> h5py.File:
            return stack.enter_context(h5py.File(path, "r"))

        holder, name = follow(file, file_format.episode_name(number).encode(), data, opened, {})
        _check_group(h5o.open(holder.id, name), f"{holder.filename}: {fsdecode(name)}", 0)


def _check_group(group: Any, where: str, depth: int) -> None:
    if not isinstance(group, h5g.GroupID) or depth > _MAX_DEPTH:
        raise DatasetError(f"{where} is no group, or holds groups within groups")
    check_links(group, f"{where}/")
    for name in group:
        place = f"{where}/{fsdecode(name)}"
        item = h5o.open(group, name)
        if isinstance(item, h5d.DatasetID):
            check_array(item, place)
        else:
            _check_group(item, place, depth + 1)
