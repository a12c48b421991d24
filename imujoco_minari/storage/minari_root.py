"""The Minari root on disk: staging folders, atomic commits, and removal of leftovers.

A dataset is built in a hidden folder of the root, which Minari does not list, and becomes visible by one
rename. The process that makes a staging folder locks it, so other processes can tell the folder of a dead
process from one in use. docs/promises.md says what users may rely on.
"""

from __future__ import annotations

import errno
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
from imujoco_minari.storage.atomic import (
    UNSUPPORTED,
    exchange,
    rename_new,
    sync_folder,
    sync_tree,
    try_lock,
    write_synced_json,
)

STAGING = ".imujoco-staging"
NAMESPACE_FILE = "namespace_metadata.json"

_LOCK = "lock"
_REPLACEMENT_NOTE, _OLD_NAME = "replacement.json", "replaced"
# Minari's grammar of ids, without the leading dots, double slashes and ".." that could leave the root.
_DATASET_ID = re.compile(r"(?:[A-Za-z0-9_][-\w]*/)+[A-Za-z0-9_][-\w]*-v[0-9]{1,6}", re.ASCII)
_HDF5_REASON = re.compile(r"error message = '([^']{1,200})'")


def datasets_root() -> Path:
    """Return the absolute path of the Minari root: ``MINARI_DATASETS_PATH``, or ``~/.minari/datasets``.

    The folder may not exist yet.

    Raises:
        StorageError: if the variable is not set and there is no home directory.
    """
    path = os.environ.get("MINARI_DATASETS_PATH")
    if path:
        # Minari doubles a relative path when it computes a dataset's size.
        return Path(path).absolute()
    try:
        return Path.home() / ".minari" / "datasets"
    except RuntimeError:
        raise StorageError("no home directory for the Minari root: set MINARI_DATASETS_PATH") from None


def dataset_folder(dataset_id: str) -> Path:
    """Return the folder of a dataset. It may not exist.

    Raises:
        DatasetIdError: if ``dataset_id`` is not a Minari id with a namespace.
    """
    if not isinstance(dataset_id, str) or len(dataset_id) > 200 or not _DATASET_ID.fullmatch(dataset_id):
        raise DatasetIdError(
            f"malformed dataset id {str(dataset_id)[:80]!r}; "
            "valid: <namespace>/<name>-v<version>, as in imujoco/hopper-all-v0"
        )
    if "data" in dataset_id.split("/"):
        # Minari reads every folder that contains a "data" as a dataset and does not look inside it.
        raise DatasetIdError(f"malformed dataset id {dataset_id!r}: a namespace cannot be named 'data'")
    return datasets_root() / dataset_id


def exists(dataset_id: str) -> bool:
    """Return whether the root has a dataset, or any other file, with this id."""
    folder = dataset_folder(dataset_id)
    try:
        folder.lstat()
    except OSError:
        return False
    return True


def taken(dataset_id: str) -> bool:
    """Remove leftovers, then return whether the root has a dataset, or any other file, with this id."""
    tidy()
    return exists(dataset_id)


@contextmanager
def storage_errors(place: Path | None = None) -> Iterator[None]:
    """Turn errors of files into a StorageError that names the file, or else ``place``."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        if isinstance(error, ImujocoError):
            raise
        if isinstance(error, OSError):
            file, reason = error.filename, error.strerror or str(error)
        else:
            # HDF5 failed to write while closing a file. h5py reports it without an error number.
            file, match = None, _HDF5_REASON.search(str(error))
            if match is None:
                raise
            reason = match[1]
        raise StorageError(
            f"cannot use the Minari root, at {file or place or datasets_root()}: {reason}"
        ) from None


@contextmanager
def staging(*dataset_ids: str) -> Iterator[Path]:
    """Make a locked staging folder in the root and remove it at the end, also after an error.

    Errors of files inside the block are raised as a StorageError.

    Args:
        *dataset_ids: ids that will be committed from it. An id that cannot be committed fails now, before
            the work.

    Raises:
        DatasetError: if an id is inside another dataset.
        StorageError: if the root cannot be written, now or inside the block.
    """
    root = datasets_root() / STAGING
    with storage_errors(root.parent):
        _make_staging_root(root)
        for dataset_id in dataset_ids:
            check_place(dataset_folder(dataset_id))
        try:
            with scratch(root) as folder:
                yield folder
        finally:
            with suppress(OSError):
                root.rmdir()


def _make_staging_root(root: Path) -> None:
    """Make the folder that contains all staging folders. Every user of a shared root may write to it."""
    root.mkdir(parents=True, exist_ok=True)
    with suppress(OSError):
        # The mode of /tmp: users can remove only their own folders. A folder of another user keeps its mode.
        root.chmod(0o1777)


@contextmanager
def scratch(parent: Path, prefix: str = "") -> Iterator[Path]:
    """Make a locked folder in ``parent`` and remove it at the end. First remove those of dead processes.

    Args:
        parent: a folder on the file system of the later rename.
        prefix: prefix of the folder's name. Only leftovers with this prefix are removed.
    """
    _remove_leftovers(parent, prefix)
    folder, lock = _make_locked_folder(parent, prefix)
    try:
        yield folder
    finally:
        _discard(folder, lock)


def check_place(target: Path) -> None:
    """Check that a folder of the staging folder can be renamed to ``target``.

    Raises:
        DatasetError: if ``target`` is inside another dataset.
        StorageError: if ``target`` is on another file system than the root.
        OSError: if a parent of ``target`` is not a writable folder.
    """
    root = datasets_root()
    for parent in target.parents:
        if parent == root:
            break
        if (parent / "data").exists():
            raise DatasetError(
                f"{target.relative_to(root)} would be within the dataset {parent.relative_to(root)}, "
                "where Minari does not find it; choose another id"
            )
        if parent.exists():
            if not parent.is_dir():
                raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(parent))
            if not os.access(parent, os.W_OK | os.X_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(parent))
            if parent.stat().st_dev != root.stat().st_dev:
                raise StorageError(
                    f"{parent} is on another file system than the Minari root {root}, so a dataset cannot be "
                    "moved there in one step: set MINARI_DATASETS_PATH to a folder of that file system"
                )


def _make_locked_folder(root: Path, prefix: str) -> tuple[Path, int]:
    """Make a folder in ``root`` and lock it. Return the folder and the descriptor of its lock."""
    while True:
        if root.name == STAGING:
            _make_staging_root(root)
        root.mkdir(parents=True, exist_ok=True)
        # Between two of these calls another process may remove a folder that is not locked yet.
        with suppress(FileNotFoundError, BlockingIOError):
            folder = Path(tempfile.mkdtemp(dir=root, prefix=prefix))
            lock = os.open(folder / _LOCK, os.O_CREAT | os.O_RDWR)
            try:
                try_lock(lock)
                if (folder / _LOCK).stat().st_ino == os.fstat(lock).st_ino:
                    return folder, lock
            except BaseException:
                os.close(lock)
                raise
            os.close(lock)


def tidy() -> None:
    """Remove the staging folders of dead processes and finish their interrupted replacements.

    Without locks on the file system, dead and living processes look the same, and nothing is removed.
    """
    _remove_leftovers(datasets_root() / STAGING)
    with suppress(OSError):
        (datasets_root() / STAGING).rmdir()


def _remove_leftovers(parent: Path, prefix: str = "") -> None:
    try:
        folders = list(parent.glob(f"{prefix}*"))
    except FileNotFoundError:
        # Another process has removed the folder meanwhile.
        return
    for folder in folders:
        try:
            # Create a missing lock: a process that died while removing its folder has removed the lock first.
            lock = os.open(folder / _LOCK, os.O_CREAT | os.O_RDWR)
        except OSError:
            continue
        try:
            dead = try_lock(lock)
        except OSError:
            dead = False
        if not dead:
            os.close(lock)
            continue
        _discard(folder, lock)


def _discard(folder: Path, lock: int) -> None:
    """Remove a staging folder that this process has locked, unless it has the only copy of a dataset."""
    removable = _finish_replacement(folder)
    if removable:
        shutil.rmtree(folder, ignore_errors=True)
    os.close(lock)
    if not removable:
        return
    # NFS renames a removed file that is open, and removes it when it is closed.
    shutil.rmtree(folder, ignore_errors=True)


def commit(staged: Path, dataset_id: str, *, replace: bool = False) -> Path:
    """Make a staged dataset visible under its id in one step and return its folder.

    Args:
        staged: the dataset's folder, which contains ``data``, directly inside :func:`staging`'s folder.
        dataset_id: the id of the dataset.
        replace: replace the dataset that has the id now. It is removed after the new one is visible.

    Raises:
        DatasetExistsError: if the id is used and ``replace`` is false; nothing has changed then.
        StorageError: if the root cannot be written.
    """
    target = dataset_folder(dataset_id)
    with storage_errors(target):
        check_place(target)
        sync_tree(staged)
        make_namespace(dataset_id.rpartition("/")[0])
        try:
            rename_new(staged, target)
        except FileExistsError:
            if not replace:
                raise DatasetExistsError(
                    f"{dataset_id} already exists, at {target}; it was not changed "
                    "(--force replaces it, `imujoco delete` removes it)"
                ) from None
            if not (target / "data").is_dir():
                raise DatasetExistsError(
                    f"{target} is not a dataset, so it was not replaced; move it away first"
                ) from None
            if not exchange(staged, target):
                _replace_in_two_steps(staged, target, dataset_id)
        sync_folder(target.parent)
    return target


def remove(dataset_id: str) -> None:
    """Remove a dataset: it disappears in one step, then its files are deleted.

    Raises:
        StorageError: when the root cannot be written.
    """
    folder = dataset_folder(dataset_id)
    with staging() as staged, storage_errors(folder):
        folder.rename(staged / "removed")
        sync_folder(folder.parent)


def make_namespace(namespace: str, description: str = "") -> None:
    """Make a Minari namespace and its parents. Existing namespaces are not changed.

    Minari's own ``create_namespace`` writes the file in place, so another process may read half of it.
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
            write_synced_json(file, {"description": description} if description else {})
            try:
                # A link fails if another process has just written the file. A rename would overwrite it.
                (folder / NAMESPACE_FILE).hardlink_to(file)
            except FileExistsError:
                pass
            except OSError as error:
                if error.errno not in {*UNSUPPORTED, errno.EPERM}:
                    raise
                file.rename(folder / NAMESPACE_FILE)


def _replace_in_two_steps(staged: Path, target: Path, dataset_id: str) -> None:
    """Move the old dataset away, then the new one in. A kill in between loses neither of them.

    A note in the staging folder describes the replacement. The next process that removes leftovers finds
    the note and finishes the replacement.
    """
    folder = staged.parent
    write_synced_json(folder / _REPLACEMENT_NOTE, {"dataset_id": dataset_id, "staged": staged.name})
    sync_folder(folder)
    target.rename(folder / _OLD_NAME)
    staged.rename(target)


def _finish_replacement(folder: Path) -> bool:
    """Finish an interrupted replacement: move the new dataset to its place, or else the old one back.

    Returns:
        Whether the folder can be removed. False if it has the old dataset and its place is empty.
    """
    if not (folder / _OLD_NAME).exists():
        return True
    try:
        note = json.loads((folder / _REPLACEMENT_NOTE).read_text("utf-8"))
        target = dataset_folder(note["dataset_id"])
        for candidate in (folder / Path(note["staged"]).name, folder / _OLD_NAME):
            with suppress(OSError):
                rename_new(candidate, target)
                sync_folder(target.parent)
        return target.exists()
    except (OSError, ValueError, KeyError, TypeError):
        return False
