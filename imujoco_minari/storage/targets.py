"""Where an export goes: written beside its place, marked, and renamed when it is whole.

The mark says that this package made the file or folder. Only what has it is ever replaced.
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
from imujoco_minari.storage import minari_root
from imujoco_minari.storage.atomic import exchange
from imujoco_minari.storage.quiet_file import writing

_PREFIX = ".imujoco-export-"
# A folder's mark is a file that lists all others, an HDF5 file's an attribute, a zip's its comment.
_LIST = ".imujoco-export.json"
_MARK = "imujoco_export"


@contextmanager
def new_target(target: Path, *, force: bool = False) -> Iterator[Path]:
    """Yield a path to write a file or folder to, which gets the name ``target`` at the end if all went well.

    Args:
        target: a folder, an HDF5 file or a zip (``.npz``).
        force: replace ``target`` if this function made it, and nothing was added to it since.

    Raises:
        DatasetExistsError: when ``target`` is there already, and ``force`` is false or does not apply.
        StorageError: when it cannot be written.
    """
    if target.exists() and not force:
        raise DatasetExistsError(f"{target} is already there; it was left alone (--force replaces it)")
    try:
        if target.exists() and not _is_marked(target):
            raise DatasetExistsError(
                f"{target} is not replaced: it is not an export of imujoco, or holds other files too; "
                "move it away, or choose another place"
            )
        target.parent.mkdir(parents=True, exist_ok=True)
        with minari_root.scratch(target.parent, _PREFIX) as staging:
            yield staging / target.name
            _mark(staging / target.name)
            _put(staging / target.name, target)
    except OSError as error:
        # An error of ours may be a builtin of this kind too, and says more.
        if type(error).__module__ != OSError.__module__:
            raise
        raise StorageError(f"cannot write {target}: {error.strerror or error}") from None


def _mark(new: Path) -> None:
    if new.is_dir():
        (new / _LIST).write_text(json.dumps(_files(new)), "utf-8")
    elif h5py.is_hdf5(new):
        with writing(new) as file:
            file.attrs[_MARK] = True
    else:
        with zipfile.ZipFile(new, "a") as archive:
            archive.comment = _MARK.encode()


def _is_marked(path: Path) -> bool:
    """Return whether :func:`new_target` made a file or folder, and nothing was added to it since."""
    try:
        if path.is_dir():
            return bool(json.loads((path / _LIST).read_text("utf-8")) == _files(path))
        if h5py.is_hdf5(path):
            with h5py.File(path, "r") as file:
                return _MARK in file.attrs
        with zipfile.ZipFile(path) as archive:
            return archive.comment == _MARK.encode()
    except (OSError, ValueError, RuntimeError, zipfile.BadZipFile) as error:
        # What cannot be read may have a mark. Damage that h5py finds has no number.
        if isinstance(error, OSError) and error.errno not in (None, errno.ENOENT):
            raise
        return False


def _files(folder: Path) -> list[str]:
    """Return the paths of all files and folders below a folder but the list of them."""
    return sorted({path.relative_to(folder).as_posix() for path in _below(folder)} - {_LIST})


def _below(folder: Path) -> Iterator[Path]:
    # Path.rglob would pass over what it may not read.
    for path in folder.iterdir():
        yield path
        if path.is_dir() and not path.is_symlink():
            yield from _below(path)


def _put(new: Path, target: Path) -> None:
    """Give ``new`` the name of ``target``; what has it now goes into the folder that ``new`` was in."""
    if not target.exists() or not (target.is_dir() or new.is_dir()):
        new.replace(target)
    elif not exchange(new, target):
        # Where a system cannot swap folders, the old one comes back if the new one does not get in.
        old = new.with_name(".old")
        target.rename(old)
        try:
            new.rename(target)
        except BaseException:
            old.rename(target)
            raise
