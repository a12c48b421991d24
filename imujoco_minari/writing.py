"""HDF5 files written so that a full disk is an ordinary error.

HDF5 cannot close a file that it cannot write to the end: it complains at every object that is let go,
and crashes as the process ends. So it writes through a file of ours, which keeps the first failure to
itself, and the failure is raised when HDF5 has closed the file in peace.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py


class _QuietFile(io.FileIO):
    """A file whose writes never fail: the first failure is kept, and nothing is written after it."""

    failure: OSError | None = None

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while rest and self.failure is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self._keep(error)
        return size

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size) if self.failure is None else size or 0
        except OSError as error:
            self._keep(error)
            return size or 0

    def _keep(self, error: OSError) -> None:
        error.filename = self.name
        self.failure = error


@contextmanager
def writing(path: Path, *, new: bool = False) -> Iterator[h5py.File]:
    """Open an HDF5 file to add to it, or, with ``new`` or where it is empty, to write it from its beginning.

    Raises:
        OSError: when something could not be written, at the latest when the file is closed.
    """
    new = new or path.stat().st_size == 0
    with _QuietFile(path, "w+" if new else "r+") as raw:
        try:
            with h5py.File(raw, "w" if new else "r+", track_order=True) as file:
                yield file
        except Exception:
            # What was not written cannot be read back, and HDF5 may have stumbled over that.
            if raw.failure is None:
                raise
        if raw.failure is not None:
            raise raw.failure
