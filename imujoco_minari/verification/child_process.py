"""Files that would take the whole process down are met by another one first.

HDF5 is a C library with a long history of crashes on damaged files, which no ``except`` catches. So a
dataset is read once by a child process, with bounds on time and memory, and only if that lives do we
read it ourselves.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from imujoco_minari.storage import file_format
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.verification.check import Part, merge
from imujoco_minari.verification.findings import Checked, Finding

MAX_MEMORY_BYTES = 2**33
# What the slowest disk worth the name needs, beside a start on a busy machine.
_START_SECONDS, _BYTES_PER_SECOND = 60, 2 * 2**20
# A child starts in the time in which it checks about a hundred.
_EPISODES_A_CHILD = 50

_BEGIN = """
import json, resource, sys
limit, place, number, count, sys.path[:] = json.loads(sys.argv[1])
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
"""
_CHECK = """
from pathlib import Path
from imujoco_minari.verification.check import check_part
print(check_part(Path(place), number, count).to_json())
"""
# All but the numbers in the arrays, which HDF5 copies without looking. What raises is told by who reads it.
_WALK = """
import contextlib, h5py
def look(name, found):
    with contextlib.suppress(Exception):
        dict(found.attrs)
        if isinstance(found, h5py.Dataset):
            found.shape, found.dtype, found.chunks, found.id.get_storage_size()
with contextlib.suppress(Exception), h5py.File(place, "r") as file:
    look("/", file)
    file.visititems(look)
"""


def survives(data: Path) -> Finding | None:
    """Read a dataset in a child process and return what became of that, or None when it lived."""
    checked = checked_apart(data)
    return checked if isinstance(checked, Finding) else None


def survives_walk(path: Path) -> Finding | None:
    """Read what an HDF5 file of any kind says of its arrays, as :func:`survives` does."""
    (said,) = _apart(_WALK, path, path)
    return said if isinstance(said, Finding) else None


def checked_apart(data: Path, jobs: int = 1) -> Checked | Finding:
    """Check a dataset in child processes and return what they found, or what became of one of them.

    Args:
        data: the folder of the dataset's storage.
        jobs: how many children at once, each with a part of the episodes.
    """
    stated = read_metadata(data).get("total_episodes")
    count = max(1, min(jobs, stated // _EPISODES_A_CHILD)) if isinstance(stated, int) else 1
    parts = []
    for said in _apart(_CHECK, data, file_format.main_file(data), count):
        part = said if isinstance(said, Finding) else _part(said)
        if isinstance(part, Finding):
            return part
        parts.append(part)
    return merge(data, parts)


def _part(said: bytes) -> Part | Finding:
    try:
        # The last line: a library may have said something before.
        return Part.from_json(said.splitlines()[-1])
    except (ValueError, TypeError, KeyError, IndexError):
        return Finding(file_format.MAIN_FILE, "cannot be read: the process that read it gave no answer")


def _apart(code: str, place: Path, file: Path, count: int = 1) -> list[bytes | Finding]:
    """Run ``code`` on ``place`` in ``count`` child processes; return what each says, or what became of it."""
    seconds = _START_SECONDS + _size(file) // _BYTES_PER_SECOND
    environment = {key: value for key, value in os.environ.items() if not key.startswith("HDF5_EXT")}
    deadline = time.monotonic() + seconds
    children: list[subprocess.Popen[bytes]] = []
    try:
        for number in range(count):
            arguments = json.dumps([MAX_MEMORY_BYTES, str(place.absolute()), number, count, sys.path])
            children.append(
                subprocess.Popen(
                    [sys.executable, "-c", _BEGIN + code, arguments],
                    env=environment | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                )
            )
        # By turns: one that waits to be heard has done its work.
        return [_heard(child, deadline, seconds, file) for child in children]
    finally:
        for child in children:
            child.kill()
            child.communicate()


def _heard(child: subprocess.Popen[bytes], deadline: float, seconds: float, file: Path) -> bytes | Finding:
    try:
        said, complaint = child.communicate(timeout=max(0.0, deadline - time.monotonic()))
    except subprocess.TimeoutExpired:
        return Finding(file.name, f"cannot be read within {seconds} seconds")
    if child.returncode < 0:
        cause = signal.Signals(-child.returncode).name
        return Finding(file.name, f"is damaged so that reading it kills the process ({cause})")
    if child.returncode:
        lines = complaint.decode("utf-8", "replace").strip().splitlines()
        return Finding(file.name, f"cannot be read: {lines[-1][:200] if lines else 'no reason given'}")
    return said


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
