"""Changes of the Minari root: staging folders, atomic commits, removals, and the removal of leftovers.

A dataset is built in a hidden folder of the root, which Minari does not list, and becomes visible by one
rename. The process that makes a staging folder locks it, so other processes can tell the folder of a dead
process from one in use. docs/promises.md says what users may rely on.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from imujoco_minari.errors import DatasetExistsError
from imujoco_minari.storage.files import (
    exchange,
    rename_new,
    sync_folder,
    sync_tree,
    try_lock,
    write_synced_json,
)
from imujoco_minari.storage.minari_root import (
    check_place,
    dataset_folder,
    datasets_root,
    exists,
    namespaces,
    storage_errors,
)

STAGING = ".imujoco-staging"
NAMESPACE_FILE = "namespace_metadata.json"

_LOCK = "lock"
_REPLACEMENT_NOTE, _OLD_NAME = "replacement.json", "replaced"


def taken(dataset_id: str) -> bool:
    """Remove leftovers, then return whether the root has a dataset, or any other file, with this id."""
    tidy()
    return exists(dataset_id)


@contextmanager
def staging(*dataset_ids: str) -> Iterator[Path]:
    """Make a locked staging folder in the root and remove it at the end, also after an error.

    Args:
        *dataset_ids: ids that will be committed from it. An id that cannot be committed fails now, before
            the work.

    Raises:
        DatasetError: if an id is inside another dataset.
        StorageError: if the root cannot be written, now or inside the block.
    """
    root = datasets_root() / STAGING
    with storage_errors(root.parent):
        for dataset_id in dataset_ids:
            check_place(dataset_folder(dataset_id))
        try:
            with scratch(root) as folder:
                yield folder
        finally:
            with suppress(OSError):
                root.rmdir()


@contextmanager
def scratch(parent: Path, prefix: str = "") -> Iterator[Path]:
    """Make a locked folder in ``parent`` and remove it at the end. First remove those of dead processes.

    The names of all these folders begin with ``prefix``.
    """
    _remove_leftovers(parent, prefix)
    folder, lock = _make_locked_folder(parent, prefix)
    try:
        yield folder
    finally:
        _discard(folder, lock)


def _make_locked_folder(root: Path, prefix: str) -> tuple[Path, int]:
    """Make a folder in ``root`` and lock it. Return the folder and the descriptor of its lock."""
    while True:
        try:
            root.mkdir(parents=True)
        except FileExistsError:
            # exist_ok=True fails too if another process removes the folder now. A link to nothing stays.
            if root.is_symlink() and not root.exists():
                raise
        if root.name == STAGING:
            # Every user of a shared root may stage. This is the mode of /tmp: users can remove only their own
            # folders. A folder of another user keeps its mode.
            with suppress(OSError):
                root.chmod(0o1777)
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
        if dead:
            _discard(folder, lock)
        else:
            os.close(lock)


def _discard(folder: Path, lock: int) -> None:
    """Remove a staging folder that this process has locked, unless it has the only copy of a dataset."""
    removable = _finish_replacement(folder)
    if removable:
        # First the old dataset: without the note, it could be the only copy.
        shutil.rmtree(folder / _OLD_NAME, ignore_errors=True)
        shutil.rmtree(folder, ignore_errors=True)
    os.close(lock)
    if removable:
        # NFS renames a removed file that is open, and removes it when it is closed. A folder with other files
        # belongs to another process, which has locked it anew.
        with suppress(OSError):
            folder.rmdir()


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
        _make_namespaces(dataset_id)
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
        StorageError: if the root cannot be written.
    """
    folder = dataset_folder(dataset_id)
    with staging() as staged, storage_errors(folder):
        folder.rename(staged / "removed")
        sync_folder(folder.parent)


def _make_namespaces(dataset_id: str) -> None:
    """Make the Minari namespaces of a dataset. Existing namespaces are not changed.

    Minari's own ``create_namespace`` writes the file in place, so another process may read half of it.
    """
    for namespace in namespaces(dataset_id):
        folder = datasets_root() / namespace
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / NAMESPACE_FILE).exists():
            continue
        with staging() as temporary:
            write_synced_json(temporary / NAMESPACE_FILE, {})
            (temporary / NAMESPACE_FILE).rename(folder / NAMESPACE_FILE)


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

    Return whether the folder can be removed: it cannot if it has the old dataset and its place is empty.
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
