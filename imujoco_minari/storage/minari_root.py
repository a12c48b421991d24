"""The Minari root on disk: staging beside the datasets, atomic commit, and the tidying of leftovers.

A dataset is built in a hidden folder of the root, which Minari does not list, and becomes visible by
one rename. A staging folder is locked by the process that made it, so that the next process can tell
what a dead one left from what a living one is at. docs/promises.md says what users may rely on.
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
_REPLACEMENT, _OLD = "replacement.json", "replaced"
# Minari's grammar of ids, without the leading dots, double slashes and ".." that could leave the root.
_DATASET_ID = re.compile(r"(?:[A-Za-z0-9_][-\w]*/)+[A-Za-z0-9_][-\w]*-v[0-9]{1,6}", re.ASCII)
_HDF5_REASON = re.compile(r"error message = '([^']{1,200})'")


def datasets_root() -> Path:
    """Return Minari's root, absolute: ``MINARI_DATASETS_PATH``, or ``~/.minari/datasets``; it need not exist.

    Raises:
        StorageError: when there is no home directory to put it in.
    """
    path = os.environ.get("MINARI_DATASETS_PATH")
    if path:
        # Minari itself doubles a relative path when it sums up a dataset's size.
        return Path(path).absolute()
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
    """Make the folder of all staging folders, in which every user of a shared root may make one."""
    root.mkdir(parents=True, exist_ok=True)
    with suppress(OSError):
        # As /tmp: each removes only what is its own. Another user's folder keeps the mode that it has.
        root.chmod(0o1777)


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


def check_place(target: Path) -> None:
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
        if root.name == STAGING:
            _make_staging_root(root)
        root.mkdir(parents=True, exist_ok=True)
        # Between any two of these calls another process may tidy away what looks abandoned.
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
            dead = try_lock(lock)
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
        staged: the dataset's folder (that holds ``data``), directly within :func:`staging`'s.
        dataset_id: the id it gets.
        replace: put it in the place of the dataset that has the id now, which goes when it is in.

    Raises:
        DatasetExistsError: when the id is taken and ``replace`` is false; nothing has changed then.
        StorageError: when the root cannot be written.
    """
    target = dataset_folder(dataset_id)
    with failures_named(target):
        check_place(target)
        sync_tree(staged)
        make_namespace(dataset_id.rpartition("/")[0])
        try:
            rename_new(staged, target)
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
        sync_folder(target.parent)
    return target


def remove(dataset_id: str) -> None:
    """Remove a dataset: it disappears in one step, then its files are deleted.

    Raises:
        StorageError: when the root cannot be written.
    """
    folder = dataset_folder(dataset_id)
    with staging() as staged, failures_named(folder):
        folder.rename(staged / "removed")
        sync_folder(folder.parent)


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
            write_synced_json(file, {"description": description} if description else {})
            try:
                # A link fails where a rename would overwrite what another process has just written.
                (folder / NAMESPACE_FILE).hardlink_to(file)
            except FileExistsError:
                pass
            except OSError as error:
                if error.errno not in {*UNSUPPORTED, errno.EPERM}:
                    raise
                file.rename(folder / NAMESPACE_FILE)


def _replace_in_two_steps(staged: Path, target: Path, dataset_id: str) -> None:
    """Move the old dataset away and the new one in, so that a kill in between loses neither.

    A note in the staging folder says what is going on; who finds it in a dead one finishes the work.
    """
    folder = staged.parent
    write_synced_json(folder / _REPLACEMENT, {"dataset_id": dataset_id, "staged": staged.name})
    sync_folder(folder)
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
                rename_new(candidate, target)
                sync_folder(target.parent)
        return target.exists()
    except (OSError, ValueError, KeyError, TypeError):
        return False
