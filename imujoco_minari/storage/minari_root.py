"""The Minari root on disk: staging beside the datasets, atomic commit, and the tidying of leftovers.

A dataset is built in a hidden folder of the root, which Minari does not list, and becomes visible by
one rename. A staging folder is locked by the process that made it, so that the next process can tell
what a dead one left from what a living one is at. docs/promises.md says what users may rely on.
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

from imujoco_minari.errors import (
    DatasetError,
    DatasetExistsError,
    DatasetIdError,
    ImujocoError,
    StorageError,
)

STAGING = ".imujoco-staging"
NAMESPACE_FILE = "namespace_metadata.json"

_LOCK = "lock"
_REPLACEMENT, _OLD = "replacement.json", "replaced"
# Minari's grammar of ids, without the leading dots, double slashes and ".." that could leave the root.
_DATASET_ID = re.compile(r"(?:[A-Za-z0-9_][-\w]*/)+[A-Za-z0-9_][-\w]*-v[0-9]{1,6}", re.ASCII)
_HDF5_REASON = re.compile(r"error message = '([^']{1,200})'")
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
# What a system or a file system answers that does not have a call.
_UNSUPPORTED = frozenset({errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOLCK})


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
        DatasetIdError: when ``dataset_id`` is no namespaced Minari id.
    """
    if not isinstance(dataset_id, str) or len(dataset_id) > 200 or not _DATASET_ID.fullmatch(dataset_id):
        raise DatasetIdError(
            f"malformed dataset id {str(dataset_id)[:80]!r}; "
            "valid: <namespace>/<name>-v<version>, as in imujoco/hopper-all-v0"
        )
    if "data" in dataset_id.split("/"):
        # Minari takes every folder that holds a "data" for a dataset and looks no deeper.
        raise DatasetIdError(f"malformed dataset id {dataset_id!r}: a namespace cannot be named 'data'")
    return datasets_root() / dataset_id


def exists(dataset_id: str) -> bool:
    """Return whether the root holds a dataset, or anything else, under this id."""
    folder = dataset_folder(dataset_id)
    try:
        folder.lstat()
    except OSError:
        return False
    return True


def taken(dataset_id: str) -> bool:
    """Tidy the root, and return whether a dataset, or anything else, has this id."""
    tidy()
    return exists(dataset_id)


@contextmanager
def failures_named(place: Path | None = None) -> Iterator[None]:
    """Raise what goes wrong with files as a StorageError that names the file, or else ``place``."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        if isinstance(error, ImujocoError):
            raise
        if isinstance(error, OSError):
            file, reason = error.filename, error.strerror or str(error)
        else:
            # HDF5 that fails to write as it closes a file, told by h5py without the error's number.
            file, match = None, _HDF5_REASON.search(str(error))
            if match is None:
                raise
            reason = match[1]
        raise StorageError(
            f"cannot use the Minari root, at {file or place or datasets_root()}: {reason}"
        ) from None


@contextmanager
def staging(*dataset_ids: str) -> Iterator[Path]:
    """Make a locked staging folder in the root, and remove it at the end, whatever happens.

    What goes wrong with files meanwhile is raised as a StorageError.

    Args:
        *dataset_ids: what will be committed from it; what stands in the way is told now, not after the work.

    Raises:
        DatasetError: when an id lies within a dataset.
        StorageError: when the root cannot be written, then or later.
    """
    root = datasets_root() / STAGING
    with failures_named(root.parent):
        root.mkdir(parents=True, exist_ok=True)
        for dataset_id in dataset_ids:
            _check_place(dataset_folder(dataset_id))
        try:
            with scratch(root) as folder:
                yield folder
        finally:
            with suppress(OSError):
                root.rmdir()


@contextmanager
def scratch(parent: Path, prefix: str = "") -> Iterator[Path]:
    """Make a locked folder in ``parent`` and remove it at the end; before, remove what dead processes left.

    Args:
        parent: on the file system on which its content is to be renamed.
        prefix: begins the folder's name, and those of the leftovers.
    """
    _tidy(parent, prefix)
    folder, lock = _locked_folder(parent, prefix)
    try:
        yield folder
    finally:
        _discard(folder, lock)


def _check_place(target: Path) -> None:
    """Raise unless ``target`` can come into being by a rename out of the staging folder."""
    root = datasets_root()
    for parent in target.parents:
        if parent == root:
            break
        if (parent / "data").exists():
            raise DatasetError(
                f"{target.relative_to(root)} would lie within the dataset {parent.relative_to(root)}, "
                "where Minari does not look"
            )
        if parent.exists():
            if not parent.is_dir():
                raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(parent))
            if not os.access(parent, os.W_OK | os.X_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(parent))
            if parent.stat().st_dev != root.stat().st_dev:
                raise StorageError(
                    f"{parent} is on another file system than the Minari root {root}, so that nothing can be "
                    "moved there in one step: set MINARI_DATASETS_PATH to a folder of that file system"
                )


def _locked_folder(root: Path, prefix: str) -> tuple[Path, int]:
    """Make a folder in ``root`` and lock it; return it and the lock's descriptor."""
    while True:
        root.mkdir(parents=True, exist_ok=True)
        # Between any two of these calls another process may tidy away what looks abandoned.
        with suppress(FileNotFoundError, BlockingIOError):
            folder = Path(tempfile.mkdtemp(dir=root, prefix=prefix))
            lock = os.open(folder / _LOCK, os.O_CREAT | os.O_RDWR)
            try:
                _lock(lock)
                if (folder / _LOCK).stat().st_ino == os.fstat(lock).st_ino:
                    return folder, lock
            except BaseException:
                os.close(lock)
                raise
            os.close(lock)


def _lock(descriptor: int) -> bool:
    """Lock a file, or raise BlockingIOError; return False where the file system has no locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _UNSUPPORTED:
            return False
        raise
    return True


def tidy() -> None:
    """Remove the staging folders of processes that are dead; leave those of the living alone.

    A replacement that was cut between its two steps is finished. Where the file system has no locks,
    nothing tells the dead from the living, and nothing is removed.
    """
    _tidy(datasets_root() / STAGING)
    with suppress(OSError):
        (datasets_root() / STAGING).rmdir()


def _tidy(parent: Path, prefix: str = "") -> None:
    try:
        folders = list(parent.glob(f"{prefix}*"))
    except FileNotFoundError:
        # Another process, the last one in it, has removed it between two looks at it.
        return
    for folder in folders:
        try:
            # Made when it is not there: a process that died while it removed its folder took its lock first.
            lock = os.open(folder / _LOCK, os.O_CREAT | os.O_RDWR)
        except OSError:
            continue
        try:
            dead = _lock(lock)
        except OSError:
            dead = False
        if not dead:
            os.close(lock)
            continue
        _discard(folder, lock)


def _discard(folder: Path, lock: int) -> None:
    """Remove a staging folder whose lock is ours, unless it holds the only copy of a dataset."""
    settled = _finish_replacement(folder)
    if settled:
        shutil.rmtree(folder, ignore_errors=True)
    os.close(lock)
    if not settled:
        return
    # NFS keeps an open file that is removed under another name until it is closed.
    shutil.rmtree(folder, ignore_errors=True)


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
    with failures_named(target):
        _check_place(target)
        _sync(staged)
        make_namespace(dataset_id.rpartition("/")[0])
        try:
            _rename_new(staged, target)
        except FileExistsError:
            if not replace:
                raise DatasetExistsError(
                    f"{dataset_id} is already there, at {target}; it was left alone "
                    "(--force replaces it, `imujoco delete` removes it)"
                ) from None
            if not (target / "data").is_dir():
                raise DatasetExistsError(
                    f"what lies at {target} is no dataset, so it is not replaced; move it away first"
                ) from None
            if not exchange(staged, target):
                _replace_in_two_steps(staged, target, dataset_id)
        _sync_folder(target.parent)
    return target


def remove(dataset_id: str) -> None:
    """Remove a dataset: it disappears in one step, then its files are deleted.

    Raises:
        StorageError: when the root cannot be written.
    """
    folder = dataset_folder(dataset_id)
    with staging() as staged, failures_named(folder):
        folder.rename(staged / "removed")
        _sync_folder(folder.parent)


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
        with staging() as temporary:
            file = temporary / NAMESPACE_FILE
            _write_json(file, {"description": description} if description else {})
            try:
                # A link fails where a rename would overwrite what another process has just written.
                (folder / NAMESPACE_FILE).hardlink_to(file)
            except FileExistsError:
                pass
            except OSError as error:
                if error.errno not in {*_UNSUPPORTED, errno.EPERM}:
                    raise
                file.rename(folder / NAMESPACE_FILE)


def _write_json(path: Path, value: object) -> None:
    with path.open("x", encoding="utf-8") as file:
        json.dump(value, file)
        file.flush()
        os.fsync(file.fileno())


def _rename_new(source: Path, target: Path) -> None:
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
    if code in _UNSUPPORTED:
        return False
    raise OSError(code, os.strerror(code), str(target))


def _replace_in_two_steps(staged: Path, target: Path, dataset_id: str) -> None:
    """Move the old dataset away and the new one in, so that a kill in between loses neither.

    A note in the staging folder says what is going on; who finds it in a dead one finishes the work.
    """
    folder = staged.parent
    _write_json(folder / _REPLACEMENT, {"dataset_id": dataset_id, "staged": staged.name})
    _sync_folder(folder)
    target.rename(folder / _OLD)
    staged.rename(target)


def _finish_replacement(folder: Path) -> bool:
    """Finish a replacement that was cut between its steps: the new dataset in place, or else the old.

    Returns:
        Whether the folder may go; false when it holds the old dataset and nothing is in its place.
    """
    if not (folder / _OLD).exists():
        return True
    try:
        note = json.loads((folder / _REPLACEMENT).read_text("utf-8"))
        target = dataset_folder(note["dataset_id"])
        for candidate in (folder / Path(note["staged"]).name, folder / _OLD):
            with suppress(OSError):
                _rename_new(candidate, target)
                _sync_folder(target.parent)
        return target.exists()
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _sync(folder: Path) -> None:
    """Force a staged dataset to the disk: a rename must not overtake what it names."""
    for parent, _, names in os.walk(folder):
        for name in names:
            sync_file(Path(parent) / name)
        _sync_folder(Path(parent))


def sync_file(path: Path) -> None:
    """Wait until what was written to a file is on the disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
    finally:
        os.close(handle)
