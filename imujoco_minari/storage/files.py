"""Files that are complete or absent: temporary names, atomic renames, locks, and syncing to the disk."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from imujoco_minari.errors import ImujocoError, StorageError

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
# Errors of a system or a file system that does not support a call.
_UNSUPPORTED = frozenset({errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOLCK})


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to. The file is renamed to ``path`` at the end, unless an error occurs.

    Raises:
        StorageError: if the file cannot be written.
    """
    # The suffix stays, because some writers choose the format by it.
    partial = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        with writing_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield partial
            partial.replace(path)
    finally:
        with suppress(OSError):
            partial.unlink()


@contextmanager
def writing_errors(path: Path) -> Iterator[None]:
    """Turn errors of files into a StorageError that says that ``path`` cannot be written."""
    try:
        yield
    except OSError as error:
        # Errors of this package are OSErrors too, and their messages say more.
        if isinstance(error, ImujocoError):
            raise
        raise StorageError(f"cannot write {path}: {error.strerror or error}") from None


def write_text(path: Path, text: str) -> None:
    """Write a text file as :func:`whole_file` does."""
    with whole_file(path) as partial:
        partial.write_text(text, "utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write a value to a JSON file as :func:`whole_file` does."""
    write_text(path, json.dumps(value, indent=1) + "\n")


def write_synced_json(path: Path, value: Any) -> None:
    """Write a new JSON file and wait until it is on the disk."""
    with path.open("x", encoding="utf-8") as file:
        json.dump(value, file)
        file.flush()
        os.fsync(file.fileno())


def rename_new(source: Path, target: Path) -> None:
    """Rename a folder to an unused name; raise FileExistsError if the name is used."""
    try:
        source.rename(target)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            raise FileExistsError(error.errno, os.strerror(error.errno), str(target)) from None
        raise


def exchange(source: Path, target: Path) -> bool:
    """Swap two folders in one step; return False if the system or the file system does not support it."""
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "renameat2"):
        return False
    if libc.renameat2(_AT_FDCWD, os.fsencode(source), _AT_FDCWD, os.fsencode(target), _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in _UNSUPPORTED:
        return False
    raise OSError(code, os.strerror(code), str(target))


def try_lock(descriptor: int) -> bool:
    """Lock a file or raise BlockingIOError; return False if the file system has no locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _UNSUPPORTED:
            return False
        raise
    return True


def sync_tree(folder: Path) -> None:
    """Wait until all files of a folder are on the disk, so that a rename cannot be stored before them."""
    for parent, _, names in os.walk(folder):
        for name in names:
            with (Path(parent) / name).open("rb") as file:
                os.fsync(file.fileno())
        sync_folder(Path(parent))


def sync_folder(folder: Path) -> None:
    """Wait until the entries of a folder are on the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
    finally:
        os.close(handle)
