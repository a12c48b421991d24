"""Reads HDF5 files in child processes first, because damaged ones can take the whole process down.

HDF5 is a C library with a long history of crashes on damaged files, which no ``except`` catches. So a
dataset is read once by a child process with limits on time and memory. Only if that survives does the main
process read it.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py

from imujoco_minari.errors import JobError
from imujoco_minari.limits import run_all_limited
from imujoco_minari.storage import file_format
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.verification import digests
from imujoco_minari.verification.check import check_part, merge
from imujoco_minari.verification.content import Content
from imujoco_minari.verification.findings import Finding, Findings

MAX_MEMORY_BYTES = 2**33
# Processor time for any file, and bytes for which a second more is given.
_SECONDS, _BYTES_PER_SECOND = 60, 2 * 2**20
# A child starts in the time in which it checks about a hundred.
_EPISODES_A_CHILD = 50

_CHECK = "imujoco_minari.verification.child_process:check_part_apart"
_WALK = "imujoco_minari.verification.child_process:walk_apart"


def survives(data: Path) -> Finding | None:
    """Read a dataset in a child process; return how the process failed, or None if it survived."""
    parts = _checked_parts(data, 1)
    return parts if isinstance(parts, Finding) else None


def survives_walk(path: Path) -> Finding | None:
    """Read what an HDF5 file of any kind states of its arrays, as :func:`survives` does."""
    (result,) = _apart(_WALK, [str(path.absolute())], path)
    return result if isinstance(result, Finding) else None


def check_apart(data: Path, metadata: Mapping[str, Any], jobs: int = 1) -> Findings:
    """Check a dataset as ``check.check`` does, in up to ``jobs`` child processes at once."""
    stated = metadata.get("total_episodes")
    count = max(1, min(jobs, stated // _EPISODES_A_CHILD)) if isinstance(stated, int) else 1
    parts = _checked_parts(data, count)
    if not isinstance(parts, Finding):
        return merge(data, metadata, parts)
    # HDF5 killed or held a child. The digests of the files do not need HDF5.
    readable = metadata and file_format.main_file(data).is_file()
    return Findings([*(digests.files(data, metadata) if readable else ()), parts], replayable=False)


def _checked_parts(data: Path, count: int) -> list[Content] | Finding:
    """Check a dataset in ``count`` child processes; return their parts, or how one of them failed."""
    arguments = [json.dumps([str(data.absolute()), number, count]) for number in range(count)]
    parts = []
    for result in _apart(_CHECK, arguments, file_format.main_file(data)):
        if isinstance(result, Finding):
            return result
        try:
            parts.append(Content.from_json(result))
        except (ValueError, TypeError, KeyError):
            words = "cannot be read: the process that read it gave no answer"
            return Finding(file_format.MAIN_FILE, words)
    return parts


def check_part_apart(argument: str) -> bytes:
    """Check a part of a dataset. A child process runs this."""
    _without_prefixes()
    place, number, count = json.loads(argument)
    return check_part(Path(place), read_metadata(Path(place)), number, count).to_json().encode()


def walk_apart(place: str) -> bytes:
    """Read all of an HDF5 file except the numbers in its arrays. A child process runs this.

    HDF5 copies the numbers without looking at them. The main process reports what raises an exception.
    """

    def look(_: str, found: h5py.Group | h5py.Dataset) -> None:
        with contextlib.suppress(Exception):
            dict(found.attrs)
            if isinstance(found, h5py.Dataset):
                (found.shape, found.dtype, found.chunks, found.id.get_storage_size())

    _without_prefixes()
    with contextlib.suppress(Exception), h5py.File(place, "r") as file:
        look("/", file)
        file.visititems(look)
    return b""


def _without_prefixes() -> None:
    """Forget where HDF5 would look for files that a file refers to."""
    for name in [name for name in os.environ if name.startswith("HDF5_EXT")]:
        del os.environ[name]


def _apart(function: str, arguments: list[str], file: Path) -> list[bytes | Finding]:
    """Call a function in child processes; return each result, or how the process failed."""
    size = file.stat().st_size if file.is_file() else 0
    seconds = _SECONDS + size // _BYTES_PER_SECOND
    results = run_all_limited(function, arguments, memory=MAX_MEMORY_BYTES, seconds=seconds)
    return [
        Finding(file.name, f"cannot be read: reading it {result}") if isinstance(result, JobError) else result
        for result in results
    ]
