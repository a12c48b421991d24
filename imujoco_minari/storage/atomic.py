"""Atomic operations of the file system: renames, exchanges and locks, and syncing to the disk."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import json
import os
from pathlib import Path

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
# Errors of a system or a file system that does not support a call.
UNSUPPORTED = frozenset({errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOLCK})


def rename_new(source: Path, target: Path) -> None:
    """Rename a folder to an unused name; raise FileExistsError if the name is used."""
    try:
        source.rename(target)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            raise FileExistsError(error.errno, os.strerror(error.errno), str(target)) from None
        raise


def exchange(source: Path, target: Path) -> bool:
    """Swap two folders in one step. At every moment ``target`` is either the old or the new folder.

    Returns:
        Whether the folders were swapped. False means that the system or the file system does not support it.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "renameat2"):
        return False
    if libc.renameat2(_AT_FDCWD, os.fsencode(source), _AT_FDCWD, os.fsencode(target), _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in UNSUPPORTED:
        return False
    raise OSError(code, os.strerror(code), str(target))


def try_lock(descriptor: int) -> bool:
    """Lock a file or raise BlockingIOError; return False if the file system has no locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in UNSUPPORTED:
            return False
        raise
    return True


def write_synced_json(path: Path, value: object) -> None:
    """Write a new JSON file and wait until it is on the disk."""
    with path.open("x", encoding="utf-8") as file:
        json.dump(value, file)
        file.flush()
        os.fsync(file.fileno())


def sync_tree(folder: Path) -> None:
    """Wait until all files of a folder are on the disk, so that a rename cannot be stored before them."""
    for parent, _, names in os.walk(folder):
        for name in names:
            sync_file(Path(parent) / name)
        sync_folder(Path(parent))


def sync_file(path: Path) -> None:
    """Wait until the content of a file is on the disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Wait until the entries of a folder are on the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in UNSUPPORTED:
            raise
    finally:
        os.close(handle)
