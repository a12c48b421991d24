"""The Minari root: where it is, where a dataset lies in it, and the errors of its file system."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from imujoco_minari.errors import DatasetError, DatasetIdError, ImujocoError, StorageError
from imujoco_minari.variants.ids import EXPERT, Variant, split_name

# Minari's grammar of ids, without the leading dots, double slashes and ".." that could leave the root.
_DATASET_ID = re.compile(r"(?:[A-Za-z0-9_][-\w]*/)+[A-Za-z0-9_][-\w]*-v[0-9]{1,6}", re.ASCII)
# A file system allows 255 bytes in a name.
_MAX_ID = 200


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
    if isinstance(dataset_id, str) and len(dataset_id) > _MAX_ID:
        raise DatasetIdError(
            f"malformed dataset id {dataset_id[:80]!r}: it has {len(dataset_id)} characters; "
            f"valid: at most {_MAX_ID}"
        )
    if not isinstance(dataset_id, str) or not _DATASET_ID.fullmatch(dataset_id):
        raise DatasetIdError(
            f"malformed dataset id {str(dataset_id)[:80]!r}{_with_namespace(dataset_id)}; "
            "valid: <namespace>/<name>-v<version>, as in imujoco/hopper-all-v0"
        )
    if len(dataset_id.rpartition("/")[0]) < 2:
        # Minari cannot parse such an id, and then lists no dataset at all.
        raise DatasetIdError(f"malformed dataset id {dataset_id!r}: a namespace has at least two characters")
    if "data" in dataset_id.split("/"):
        # Minari reads every folder that contains a "data" as a dataset and does not look inside it.
        raise DatasetIdError(f"malformed dataset id {dataset_id!r}: a namespace cannot be named 'data'")
    return datasets_root() / dataset_id


def namespaces(dataset_id: str) -> list[str]:
    """Return the namespaces that contain a dataset, the outermost first."""
    parts = dataset_id.split("/")
    return ["/".join(parts[:depth]) for depth in range(1, len(parts))]


def _with_namespace(name: object) -> str:
    """Return the dataset id that was probably meant, if this is the id of a variant."""
    try:
        variant, tier = split_name(str(name)[:_MAX_ID].removesuffix("-v0"))
        return f" (did you mean {Variant.parse(variant).dataset_id(tier or EXPERT)!r}?)"
    except ImujocoError:
        return ""


def exists(dataset_id: str) -> bool:
    """Return whether the root has a dataset, or any other file, with this id."""
    return os.path.lexists(dataset_folder(dataset_id))


def folder_identity(folder: Path) -> tuple[int, int]:
    """Return device and inode of a folder. They change when a dataset is replaced.

    Raises:
        OSError: if the folder does not exist.
    """
    state = folder.stat()
    return state.st_dev, state.st_ino


@contextmanager
def storage_errors(place: Path | None = None) -> Iterator[None]:
    """Turn errors of files into a StorageError that names the file, or else ``place``."""
    try:
        yield
    except OSError as error:
        if isinstance(error, ImujocoError):
            raise
        place = error.filename or place or datasets_root()
        raise StorageError(f"cannot use the Minari root, at {place}: {error.strerror or error}") from None


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
