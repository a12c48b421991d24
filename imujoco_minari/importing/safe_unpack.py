"""Zips from outside, read within bounds: no path may leave its folder, nothing may fill memory or disk.

Sizes are checked as the zip states them, before anything is unpacked; ``zipfile`` gives no more than an
entry states. Arrays of an ``.npz`` are checked against their header before they are allocated.
"""

from __future__ import annotations

import errno
import re
import shutil
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import DatasetError, DatasetNotFoundError, ImujocoError

Array = NDArray[Any]

MAX_ENTRIES = 10_000
# The original's dataset.zip has 2.7 GB for 154 variants, 100,000 rows each.
MAX_ENTRY_BYTES = 2**30
MAX_TOTAL_BYTES = 64 * 2**30

_DEVICES = re.compile(r"(?:con|prn|aux|nul|com[0-9]|lpt[0-9])(?:\..*)?", re.IGNORECASE)
# What zipfile and NumPy were seen to raise of broken files; fuzzing found the last three.
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
)


@contextmanager
def open_zip(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open a zip whose every entry is a plain file or folder, within the zip's own tree and within bounds.

    Raises:
        DatasetNotFoundError: when there is no such file.
        DatasetError: when it is no zip, or holds an entry that is refused; nothing is read of it then.
    """
    if not path.is_file():
        raise DatasetNotFoundError(f"no file at {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            _check(archive, path)
            yield archive
    except ImujocoError:
        raise
    except (*_BROKEN, OSError) as error:
        # A place before the file's beginning, which a broken directory of entries can name, is invalid.
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
        DatasetNotFoundError: when there is no such file.
        DatasetError: when it is no ``.npz`` of numbers, or claims more than a dataset of ours can have.
    """
    arrays = {}
    with open_zip(path) as archive:
        for info in archive.infolist():
            if info.filename.endswith(".npy"):
                name = info.filename.removesuffix(".npy")
                with archive.open(info) as stream:
                    arrays[name] = _read_npy(stream, info.file_size, f"{path}: {name[:80]!r}")
    if not arrays:
        raise DatasetError(f"{path}: holds no array")
    return arrays


def _read_npy(stream: IO[bytes], size: int, name: str) -> Array:
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_2_0(stream)
    else:
        raise DatasetError(f"{name} is of the .npy version {version}; valid: (1, 0), (2, 0)")
    if dtype.kind not in "fiub":
        raise DatasetError(f"{name} is of type {str(dtype)[:40]}, not of numbers")
    nbytes = dtype.itemsize
    for length in shape:
        nbytes *= length
    if not 0 <= nbytes <= size:
        raise DatasetError(f"{name} claims {nbytes} bytes, but its entry has {size}")
    data = stream.read(nbytes)
    if len(data) != nbytes:
        raise DatasetError(f"{name} ends after {len(data)} of {nbytes} bytes")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")


def _check(archive: zipfile.ZipFile, path: Path) -> None:
    infos = archive.infolist()
    if len(infos) > MAX_ENTRIES:
        raise DatasetError(f"{path}: holds {len(infos)} entries; the limit is {MAX_ENTRIES}")
    seen: set[str] = set()
    for info in infos:
        reason = _refusal(info) or ("is there twice" if info.filename.lower() in seen else "")
        if reason:
            raise DatasetError(f"{path}: refused, for its entry {info.orig_filename[:120]!r} {reason}")
        seen.add(info.filename.lower())
    total = sum(info.file_size for info in infos)
    if total > MAX_TOTAL_BYTES:
        raise DatasetError(f"{path}: would unpack to {total} bytes; the limit is {MAX_TOTAL_BYTES}")


def _refusal(info: zipfile.ZipInfo) -> str:
    """Return why an entry is refused; empty when it is not."""
    name = info.orig_filename
    parts = name.removesuffix("/").split("/")
    if name.startswith(("/", "\\")) or re.match(r"[A-Za-z]:", name):
        return "has an absolute path"
    if ".." in parts or "\\" in name:
        return "has a path that could leave the folder"
    if any(not part or part == "." or len(part) > 255 for part in parts) or not name.isprintable():
        return "has a malformed path"
    if any(_DEVICES.fullmatch(part) for part in parts):
        return "is named as a device"
    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        return "is a link or another special file"
    if info.flag_bits & 0x1:
        return "is encrypted"
    if info.file_size > MAX_ENTRY_BYTES:
        return f"would unpack to {info.file_size} bytes; the limit is {MAX_ENTRY_BYTES}"
    return ""


def one_of(arrays: Mapping[str, Array], *names: str) -> Array | None:
    """Return the first of the arrays that goes by one of ``names``; None when none does."""
    return next((arrays[name] for name in names if name in arrays), None)
