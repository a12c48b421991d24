"""The Minari root on disk: staging beside the datasets, atomic commit, and the tidying of leftovers.

A dataset is built in a hidden folder of the root, which Minari does not list, and becomes visible by
one rename. A staging folder is locked by the process that made it, so that the next process can tell
what a dead one left from what a living one is at.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from imujoco_minari.errors import DatasetError, DatasetExistsError, StorageError

STAGING = ".imujoco-staging"
NAMESPACE_FILE = "namespace_metadata.json"

_LOCK = "lock"
# Minari's grammar of ids, without the leading dots, double slashes and ".." that could leave the root.
_DATASET_ID = re.compile(r"(?:[A-Za-z0-9_][-\w]*/)+[A-Za-z0-9_][-\w]*-v[0-9]{1,6}", re.ASCII)
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


def datasets_root() -> Path:
    """Return Minari's root: ``MINARI_DATASETS_PATH``, or ``~/.minari/datasets``; it need not exist.

    Raises:
        StorageError: when there is no home directory to put it in.
    """
    path = os.environ.get("MINARI_DATASETS_PATH")
    if path:
        return Path(path)
    try:
        return Path.home() / ".minari" / "datasets"
    except RuntimeError:
        raise StorageError("no home directory for the Minari root: set MINARI_DATASETS_PATH") from None


def dataset_folder(dataset_id: str) -> Path:
    """Return where the dataset ``dataset_id`` lies or would lie.

    Raises:
        DatasetError: when ``dataset_id`` is no namespaced Minari id.
    """
    if not isinstance(dataset_id, str) or len(dataset_id) > 200 or not _DATASET_ID.fullmatch(dataset_id):
        raise DatasetError(
            f"malformed dataset id {str(dataset_id)[:80]!r}; "
            "valid: <namespace>/<name>-v<version>, as in imujoco/hopper-all-v0"
        )
    return datasets_root() / dataset_id


def exists(dataset_id: str) -> bool:
    """Return whether the root holds a dataset, or anything else, under this id."""
    return dataset_folder(dataset_id).exists()


@contextmanager
def staging() -> Iterator[Path]:
    """Make a locked staging folder in the root, and remove it at the end, whatever happens.

    Raises:
        StorageError: when the root cannot be written.
    """
    root = datasets_root() / STAGING
    try:
        root.mkdir(parents=True, exist_ok=True)
        tidy()
        folder, lock = _locked_folder(root)
    except OSError as error:
        raise _storage_error(error, root.parent) from None
    try:
        yield folder
    except OSError as error:
        if type(error) in (OSError, PermissionError):
            raise _storage_error(error, root.parent) from None
        raise
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)
        with suppress(OSError):
            root.rmdir()


def _locked_folder(root: Path) -> tuple[Path, int]:
    """Make a folder in the staging root and lock it; return it and the lock's descriptor."""
    while True:
        root.mkdir(parents=True, exist_ok=True)
        # Between any two of these calls another process may tidy away what looks abandoned.
        with suppress(FileNotFoundError, BlockingIOError):
            folder = Path(tempfile.mkdtemp(dir=root))
            lock = os.open(folder / _LOCK, os.O_CREAT | os.O_RDWR)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if (folder / _LOCK).stat().st_ino == os.fstat(lock).st_ino:
                    return folder, lock
            except BaseException:
                os.close(lock)
                raise
            os.close(lock)


def tidy() -> None:
    """Remove the staging folders of processes that are dead; leave those of the living alone."""
    for folder in (datasets_root() / STAGING).glob("*"):
        try:
            lock = os.open(folder / _LOCK, os.O_RDWR)
        except FileNotFoundError:
            # Made a moment ago, or left by a process that died in that moment.
            with suppress(OSError):
                folder.rmdir()
            continue
        except OSError:
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
        except OSError:
            pass
        finally:
            os.close(lock)


def commit(staged: Path, dataset_id: str, *, replace: bool = False) -> Path:
    """Make the staged dataset visible under its id in one step, and return its folder.

    Args:
        staged: the dataset's folder (that holds ``data``), within :func:`staging`.
        dataset_id: the id it gets.
        replace: put it in the place of the dataset that has the id now, which goes when it is in.

    Raises:
        DatasetExistsError: when the id is taken and ``replace`` is false; nothing has changed then.
        StorageError: when the root cannot be written.
    """
    target = dataset_folder(dataset_id)
    try:
        _sync(staged)
        make_namespace(dataset_id.rpartition("/")[0])
        try:
            _rename_new(staged, target)
        except FileExistsError:
            if not replace:
                raise DatasetExistsError(
                    f"{dataset_id} is already there, at {target}; it was left alone "
                    "(--force replaces it, `minari delete` removes it)"
                ) from None
            _exchange(staged, target)
        _sync_folder(target.parent)
    except DatasetExistsError:
        raise
    except OSError as error:
        raise _storage_error(error, target) from None
    return target


def make_namespace(namespace: str, description: str = "") -> None:
    """Make a Minari namespace and its parents; one that exists is left as it is.

    Minari's own ``create_namespace`` writes the file in place, where another process may read half of it.
    """
    root = datasets_root()
    parts = namespace.split("/")
    for depth in range(1, len(parts) + 1):
        folder = root.joinpath(*parts[:depth])
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / NAMESPACE_FILE).exists():
            continue
        handle, name = tempfile.mkstemp(dir=folder, prefix=".namespace-")
        try:
            with os.fdopen(handle, "w") as file:
                json.dump({"description": description} if description else {}, file)
                file.flush()
                os.fsync(file.fileno())
            Path(name).chmod(0o644)
            # A link fails where a rename would overwrite what another process has just written.
            with suppress(FileExistsError):
                (folder / NAMESPACE_FILE).hardlink_to(name)
        finally:
            Path(name).unlink()


def _rename_new(source: Path, target: Path) -> None:
    """Rename a folder to a name that is free; raise FileExistsError when it is not."""
    try:
        source.rename(target)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            raise FileExistsError(error.errno, os.strerror(error.errno), str(target)) from None
        raise


def _exchange(source: Path, target: Path) -> None:
    """Swap two folders in one step, so that at every moment ``target`` is the old or the new one."""
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "renameat2"):
        raise StorageError(
            f"{target}: this system cannot replace a dataset in one step; `minari delete` it first"
        )
    if libc.renameat2(_AT_FDCWD, os.fsencode(source), _AT_FDCWD, os.fsencode(target), _RENAME_EXCHANGE) != 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code), str(target))


def _sync(folder: Path) -> None:
    """Force a staged dataset to the disk: a rename must not overtake what it names."""
    for parent, _, names in os.walk(folder):
        for name in names:
            with (Path(parent) / name).open("rb") as file:
                os.fsync(file.fileno())
        _sync_folder(Path(parent))


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _storage_error(error: OSError, place: Path) -> StorageError:
    return StorageError(
        f"cannot write to the Minari root, at {error.filename or place}: {error.strerror or error}"
    )
