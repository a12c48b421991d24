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
from pathlib import Path

from imujoco_minari import content
from imujoco_minari.verification.findings import Checked, Finding

MAX_MEMORY_BYTES = 2**33
# What the slowest disk worth the name needs, beside a start on a busy machine.
_START_SECONDS, _BYTES_PER_SECOND = 60, 2 * 2**20

_BEGIN = """
import json, resource, sys
limit, place, sys.path[:] = json.loads(sys.argv[1])
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
"""
_CHECK = """
from pathlib import Path
from imujoco_minari.verification import check
checked = check(Path(place))
json.dump([[(f.where, f.what) for f in checked.findings], checked.replayable], sys.stdout)
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
    said = _apart(_WALK, path, path)
    return said if isinstance(said, Finding) else None


def checked_apart(data: Path) -> Checked | Finding:
    """Check a dataset in a child process and return what that found, or what became of it."""
    said = _apart(_CHECK, data, content.main_file(data))
    if isinstance(said, Finding):
        return said
    try:
        # The last line: a library may have said something before.
        findings, replayable = json.loads(said.splitlines()[-1])
    except (ValueError, IndexError):
        return Finding(content.MAIN_FILE, "cannot be read: the process that read it gave no answer")
    return Checked([Finding(where, what) for where, what in findings], replayable)


def _apart(code: str, place: Path, file: Path) -> bytes | Finding:
    """Run ``code`` on ``place`` in a child process; return what it says, or what became of it."""
    seconds = _START_SECONDS + _size(file) // _BYTES_PER_SECOND
    environment = {key: value for key, value in os.environ.items() if not key.startswith("HDF5_EXT")}
    arguments = json.dumps([MAX_MEMORY_BYTES, str(place.absolute()), sys.path])
    try:
        done = subprocess.run(
            [sys.executable, "-c", _BEGIN + code, arguments],
            env=environment | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            capture_output=True,
            timeout=seconds,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Finding(file.name, f"cannot be read within {seconds} seconds")
    if done.returncode < 0:
        cause = signal.Signals(-done.returncode).name
        return Finding(file.name, f"is damaged so that reading it kills the process ({cause})")
    if done.returncode:
        lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
        return Finding(file.name, f"cannot be read: {lines[-1][:200] if lines else 'no reason given'}")
    return done.stdout


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
