"""The target of an export: it is written under a temporary name, marked, and renamed when it is complete.

The mark states that this package made the file or folder. Only marked files and folders are ever replaced.
"""

from __future__ import annotations

import errno
import json
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

from imujoco_minari.errors import DatasetExistsError, StorageError
from imujoco_minari.storage import transactions
from imujoco_minari.storage.files import exchange, writing_errors
from imujoco_minari.storage.quiet_file import writing

_PREFIX = ".imujoco-export-"
# The mark of a folder is a file that lists all others, of an HDF5 file an attribute, of a zip its comment.
_FILE_LIST = ".imujoco-export.json"
_MARK = "imujoco_export"


@contextmanager
def new_target(target: Path, *, force: bool = False) -> Iterator[Path]:
    """Yield a temporary path to write a file or folder to. It is renamed to ``target`` on success.

    Args:
        target: a folder, an HDF5 file or a zip (``.npz``).
        force: replace ``target`` if this function made it and nothing was added to it since.

    Raises:
        DatasetExistsError: if ``target`` exists, and ``force`` is false or ``target`` has no mark.
        StorageError: if ``target`` cannot be written, or is a folder that the file system cannot replace in
            one step.
    """
    with writing_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        # First, because this removes what a killed export left, also beside a target that it completed.
        with transactions.scratch(target.parent, _PREFIX) as staging:
            if target.exists() and not force:
                raise DatasetExistsError(f"{target} already exists; it was not changed (--force replaces it)")
            if target.exists() and not _is_marked(target):
                raise DatasetExistsError(
                    f"{target} was not replaced: it is not an export of imujoco, or it has other files too; "
                    "move it away, or choose another path"
                )
            yield staging / target.name
            _write_mark(staging / target.name)
            _move_into_place(staging / target.name, target)


def _write_mark(new: Path) -> None:
    if new.is_dir():
        (new / _FILE_LIST).write_text(json.dumps(_list_files(new)), "utf-8")
    elif h5py.is_hdf5(new):
        with writing(new) as file:
            file.attrs[_MARK] = True
    else:
        with zipfile.ZipFile(new, "a") as archive:
            archive.comment = _MARK.encode()


def _is_marked(path: Path) -> bool:
    """Return whether :func:`new_target` made a file or folder and nothing was added to it since."""
    try:
        if path.is_dir():
            return bool(json.loads((path / _FILE_LIST).read_text("utf-8")) == _list_files(path))
        if h5py.is_hdf5(path):
            with h5py.File(path, "r") as file:
                return _MARK in file.attrs
        with zipfile.ZipFile(path) as archive:
            return archive.comment == _MARK.encode()
    except (OSError, ValueError, RuntimeError, zipfile.BadZipFile) as error:
        # A file that cannot be read may have a mark. Errors of damaged HDF5 files have no number.
        if isinstance(error, OSError) and error.errno not in (None, errno.ENOENT):
            raise
        return False


def _list_files(folder: Path) -> list[str]:
    """Return the paths of all files and folders in a folder, except the list itself."""
    return sorted({path.relative_to(folder).as_posix() for path in _walk(folder)} - {_FILE_LIST})


def _walk(folder: Path) -> Iterator[Path]:
    # Path.rglob skips folders that it cannot read.
    for path in folder.iterdir():
        yield path
        if path.is_dir() and not path.is_symlink():
            yield from _walk(path)


def _move_into_place(new: Path, target: Path) -> None:
    """Rename ``new`` to ``target``. A replaced folder is moved to the folder of ``new``."""
    if not target.exists() or not (target.is_dir() or new.is_dir()):
        new.replace(target)
    elif not exchange(new, target):
        # A kill between two renames would lose both folders.
        raise StorageError(
            f"{target} was not replaced: its file system cannot replace a folder in one step; delete it first"
        )
