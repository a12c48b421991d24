"""A dataset takes its values from its own file, or by links from other datasets of the Minari root.

HDF5 would follow links and "external storage" to any file of the reader's machine. Every reader of this
package checks an episode here first.
"""

from __future__ import annotations

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

_MAX_LINKS, _MAX_DEPTH = 4, 4


class LinkedFiles(ExitStack):
    """The file of a dataset, and the files of other datasets to which its episodes are links.

    A file is opened when a link first leads to it. All are closed at the end of the ``with`` block.

    Args:
        path: absolute path of the dataset's HDF5 file.
        **options: options of :class:`h5py.File`.

    Raises:
        OSError: if the file cannot be opened, here or when a link leads to it.
    """

    def __init__(self, path: Path, **options: Any) -> None:
        super().__init__()
        self._options = options
        self._opened: dict[Path, h5py.File] = {}
        # For the folder and the file name of a link: the file, and its folder.
        self._followed: dict[tuple[Path, bytes], tuple[h5py.File, Path]] = {}
        self._data = path.parent
        self.file = self._open(path)

    def find(self, number: int) -> tuple[h5py.File, bytes]:
        """Return the file that holds an episode, and the episode's name in it.

        Raises:
            DatasetError: if the episode is a link that leads out of the root, or through too many files.
            KeyError: if there is no such episode.
        """
        file, data, name = self.file, self._data, file_format.episode_name(number).encode()
        depth = 0
        while True:
            links = file.id.links
            try:
                kind = links.get_info(name).type
            except RuntimeError:
                raise KeyError(name) from None
            if kind == h5l.TYPE_HARD:
                return file, name
            if kind != h5l.TYPE_EXTERNAL:
                raise DatasetError(
                    f"{file.filename}: {fsdecode(name)} is a soft link, which datasets do not have"
                )
            filename, target = links.get_val(name)
            target = target.strip(b"/")
            found = None if b"/" in target or depth == _MAX_LINKS else self._follow(data, filename)
            if found is None:
                raise DatasetError(
                    f"{file.filename}: {fsdecode(name)} refers to {fsdecode(filename)[:80]!r}, "
                    "which is no dataset of the Minari root"
                )
            (file, data), name = found, target
            depth += 1

    def check(self, number: int) -> None:
        """Check that an episode takes all its values from datasets of the Minari root.

        Raises:
            DatasetError: if it does not.
            KeyError: if there is no such episode.
        """
        file, name = self.find(number)
        _check_group(h5o.open(file.id, name), f"{file.filename}: {fsdecode(name)}", 0)

    def _follow(self, data: Path, filename: bytes) -> tuple[h5py.File, Path] | None:
        """Return the file that a link leads to, and its folder; None if it is no dataset of the same root."""
        link = data, filename
        if link not in self._followed:
            path = _linked_path(data, fsdecode(filename))
            if path is None:
                return None
            # A staged dataset may be a link to the folder of one in the root.
            folder = path.parent.resolve() if path.parent.parent.is_symlink() else path.parent
            self._followed[link] = self._open(path), folder
        return self._followed[link]

    def _open(self, path: Path) -> h5py.File:
        if path not in self._opened:
            self._opened[path] = self.enter_context(h5py.File(path, "r", **self._options))
        return self._opened[path]


def _linked_path(data: Path, filename: str) -> Path | None:
    """Return the path of the file that a link in the folder ``data`` leads to, or None if it leaves the root.

    For a staged dataset, the staging folder stands for the root, so its links are checked as they will be.
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
