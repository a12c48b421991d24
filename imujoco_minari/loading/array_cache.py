"""Loaded arrays on disk, as ``.npy`` files that are mapped instead of read.

An entry is named by the digest of all that decides its content: the datasets' ``content_sha256``, the
selection and the dtype. It becomes visible by one rename and is never changed, so processes may share it.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import DTypeLike, NDArray

from imujoco_minari.errors import StorageError
from imujoco_minari.loading.selection import Source
from imujoco_minari.storage import minari_root
from imujoco_minari.storage.file_format import main_file

Array = NDArray[Any]

# Part of every key: a change of what is stored makes the entries of before unreachable.
_FORMAT = 1
_TABLE = "table.json"


def cache_folder() -> Path:
    """Return where entries lie: ``$IMUJOCO_HOME/arrays``, or ``~/.imujoco/arrays``.

    Raises:
        StorageError: when there is no home directory to put it in.
    """
    home = os.environ.get("IMUJOCO_HOME")
    try:
        return (Path(home) if home else Path.home() / ".imujoco") / "arrays"
    except RuntimeError:
        raise StorageError("no home directory for the cache: set IMUJOCO_HOME") from None


def key(
    sources: Sequence[Source],
    where: Mapping[str, Any],
    portion: tuple[float, float],
    seed: int,
    dtype: DTypeLike | None,
    normalized: Any,
) -> str:
    """Return the name of the entry that holds these arrays; ``normalized`` says by what, as JSON."""
    parts = {
        "format": _FORMAT,
        # The id too: variants that do not differ in effect have the same arrays and another table.
        "sources": [[source.dataset_id, _digest(source.file), source.episodes] for source in sources],
        "where": {name: _words(wanted) for name, wanted in where.items()},
        "portion": [float(bound) for bound in portion],
        "seed": seed if portion != (0, 1) else None,
        "dtype": dtype and np.dtype(dtype).str,
        "normalize": normalized,
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def _words(wanted: Any) -> list[str]:
    several = isinstance(wanted, Collection) and not isinstance(wanted, str)
    return sorted(map(str, wanted)) if several else [str(wanted)]


def _digest(file: Path) -> list[Any]:
    """Return what tells a dataset's content: its digest, those of what it links to, or its file's state."""
    with h5py.File(file, "r") as opened:
        if "content_sha256" in opened.attrs:
            return [str(opened.attrs["content_sha256"])]
    state = file.stat()
    own = [str(file.resolve()), state.st_size, state.st_mtime_ns]
    metadata = json.loads((file.parent / "metadata.json").read_text("utf-8"))
    linked = [
        main_file(minari_root.dataset_folder(name) / "data") for name in metadata.get("combined_datasets", [])
    ]
    return own + [_digest(source) for source in linked if source.is_file()]


def load(name: str, arrays: Sequence[str]) -> tuple[dict[str, Array], Any] | None:
    """Return arrays of the entry ``name``, mapped (changes stay in memory), and what describes them.

    None when there is no such entry.
    """
    folder = cache_folder() / name
    try:
        described = json.loads((folder / _TABLE).read_text("utf-8"))
        return {array: np.load(folder / f"{array}.npy", mmap_mode="c") for array in arrays}, described
    except (OSError, ValueError, EOFError):
        return None


def store(name: str, arrays: Mapping[str, Array], described: Any) -> None:
    """Store arrays, and JSON that describes them, as the entry ``name``.

    Raises:
        StorageError: when the cache folder cannot be written.
    """
    root = cache_folder()
    staged = None
    try:
        root.mkdir(parents=True, exist_ok=True)
        staged = Path(tempfile.mkdtemp(prefix=".new-", dir=root))
        for array, values in arrays.items():
            np.save(staged / f"{array}.npy", values)
        (staged / _TABLE).write_text(json.dumps(described), "utf-8")
        if load(name, list(arrays)) is None:
            # What is left of an entry that someone deleted by half would stand in the way.
            shutil.rmtree(root / name, ignore_errors=True)
            staged.rename(root / name)
    except OSError as error:
        if not (root / name / _TABLE).exists():
            raise StorageError(f"cannot write to the cache, at {root}: {error.strerror or error}") from None
    finally:
        if staged is not None:
            shutil.rmtree(staged, ignore_errors=True)
