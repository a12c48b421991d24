"""Steps on a file system that happen whole or not at all: renames, exchanges, locks, waits for the disk."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import json
import os
from pathlib import Path

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
# Errors of a system or a file system that lacks a call.
UNSUPPORTED = frozenset({errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOLCK})


def rename_new(source: Path, target: Path) -> None:
    """Rename a folder to a name that is free; raise FileExistsError when it is not."""
    try:
        source.rename(target)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            raise FileExistsError(error.errno, os.strerror(error.errno), str(target)) from None
        raise


def exchange(source: Path, target: Path) -> bool:
    """Swap two folders in one step, so that at every moment ``target`` is the old or the new one.

    Returns:
        Whether it was done: False where the system or the file system cannot, and nothing has changed.
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
    """Lock a file, or raise BlockingIOError; return False where the file system has no locks."""
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
    """Force a staged dataset to the disk: a rename must not overtake what it names."""
    for parent, _, names in os.walk(folder):
        for name in names:
            sync_file(Path(parent) / name)
        sync_folder(Path(parent))


def sync_file(path: Path) -> None:
    """Wait until what was written to a file is on the disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in UNSUPPORTED:
            raise
    finally:
        os.close(handle)
