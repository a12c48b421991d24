"""Zips and ``.npz`` files from outside, read within bounds.

A zip states the size of each entry, and ``zipfile`` never returns more. All sizes are checked before anything
is unpacked. The header of an array is checked before memory is allocated for the array. The name of an entry
never decides where a file is written: the caller names the target.
"""

from __future__ import annotations

import errno
import math
import shutil
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import DatasetError, DatasetNotFoundError, ImujocoError

Array = NDArray[Any]

MAX_ENTRIES = 10_000
# The original's dataset.zip has 2.7 GB for 154 variants. Its entries are unpacked one at a time.
MAX_ENTRY_BYTES = 2**30
MAX_TOTAL_BYTES = 64 * 2**30
# The arrays of one input are in memory together, as float64: 1 GiB, three million steps of HalfCheetah.
MAX_NUMBERS = 2**27

# The exceptions of zipfile and NumPy for broken files. Fuzzing found the last four.
_BROKEN = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    struct.error,
    NotImplementedError,
    RuntimeError,
    ValueError,
    tokenize.TokenError,
    LookupError,
    TypeError,
    SyntaxError,
)


class Allowance:
    """The number of values that may still be read from one input, over all its arrays."""

    def __init__(self) -> None:
        self._left = MAX_NUMBERS

    def take(self, count: int, name: str) -> None:
        """Take ``count`` numbers for the array ``name``.

        Raises:
            DatasetError: when fewer are left.
        """
        if not 0 <= count <= self._left:
            raise DatasetError(
                f"{name} claims {count} numbers; the arrays of one import may have {MAX_NUMBERS} together"
            )
        self._left -= count


@contextmanager
def open_zip(path: Path, max_bytes: int = MAX_TOTAL_BYTES) -> Iterator[zipfile.ZipFile]:
    """Open a zip whose entries unpack to ``max_bytes`` at most, all together.

    Raises:
        DatasetNotFoundError: when the file does not exist.
        DatasetError: when it is no zip, or is too large; then nothing of it has been read.
    """
    if not path.is_file():
        raise DatasetNotFoundError(f"no file at {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            _check_sizes(archive, path, max_bytes)
            yield archive
    except ImujocoError:
        raise
    except (*_BROKEN, OSError) as error:
        # A broken directory of entries can name an offset before the file's beginning: EINVAL.
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            raise
        raise DatasetError(f"{path}: not a readable zip: {' '.join(str(error).split())[:200]}") from None


def unpack(archive: zipfile.ZipFile, name: str, target: Path) -> None:
    """Write one entry of a zip opened by :func:`open_zip` to the new file ``target``."""
    with archive.open(name) as source, target.open("xb") as file:
        shutil.copyfileobj(source, file, 2**20)


def read_npz(path: Path) -> dict[str, Array]:
    """Return the arrays of an ``.npz`` file by name, without unpickling anything.

    Raises:
        DatasetNotFoundError: when the file does not exist.
        DatasetError: when it is no ``.npz`` of numbers, or its arrays are too large together.
    """
    arrays, allowance = {}, Allowance()
    with open_zip(path, MAX_ENTRY_BYTES) as archive:
        for info in archive.infolist():
            if info.filename.endswith(".npy"):
                name = info.filename.removesuffix(".npy")
                with archive.open(info) as stream:
                    arrays[name] = _read_npy(stream, info.file_size, f"{path}: {name[:80]!r}", allowance)
    if not arrays:
        raise DatasetError(f"{path}: holds no array")
    return arrays


def _read_npy(stream: IO[bytes], size: int, name: str, allowance: Allowance) -> Array:
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_2_0(stream)
    else:
        raise DatasetError(f"{name} is of the .npy version {version}; valid: (1, 0), (2, 0)")
    if dtype.kind not in "fiub":
        raise DatasetError(f"{name} is of type {str(dtype)[:40]}, not of numbers")
    nbytes = dtype.itemsize * math.prod(shape)
    if not 0 <= nbytes <= size:
        raise DatasetError(f"{name} claims {nbytes} bytes, but its entry has {size}")
    allowance.take(math.prod(shape), name)
    data = stream.read(nbytes)
    if len(data) != nbytes:
        raise DatasetError(f"{name} ends after {len(data)} of {nbytes} bytes")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")


def _check_sizes(archive: zipfile.ZipFile, path: Path, max_bytes: int) -> None:
    infos = archive.infolist()
    if len(infos) > MAX_ENTRIES:
        raise DatasetError(f"{path}: holds {len(infos)} entries; the limit is {MAX_ENTRIES}")
    for info in infos:
        if info.file_size > MAX_ENTRY_BYTES:
            raise DatasetError(
                f"{path}: its entry {info.orig_filename[:120]!r} would unpack to {info.file_size} bytes; "
                f"the limit is {MAX_ENTRY_BYTES}"
            )
    total = sum(info.file_size for info in infos)
    if total > max_bytes:
        raise DatasetError(f"{path}: would unpack to {total} bytes; the limit is {max_bytes}")
