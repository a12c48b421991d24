"""HDF5 files written so that a full disk is an ordinary error.

HDF5 cannot close a file that it cannot write to the end: it complains at every object that is let go,
and crashes as the process ends. So it writes through a file of ours, which keeps the first failure to
itself, and the failure is raised when HDF5 has closed the file in peace. Nor can a Ctrl-C pass through
HDF5, which calls our file: one that comes at such a moment comes again a moment later.
"""

from __future__ import annotations

import _thread
import inspect
import io
import signal
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
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


# Code that an interrupt must not leave by an exception: HDF5 calls it, it opens or closes the file, or
# it is called as an object goes, when Python would print the exception and go on.
_UNDISTURBED = {
    inspect.unwrap(function).__code__
    for function in (_QuietFile.write, _QuietFile.truncate, h5py.File.__init__, h5py.File.close)
}
_UNDISTURBED_FILE = weakref.__file__


@contextmanager
def polite_interrupts() -> Iterator[None]:
    """Handle an interrupt at once, or, where its exception would pass through HDF5, a moment later."""
    handler = signal.getsignal(signal.SIGINT)
    # Only the main thread may set a handler, and only where there is one does an exception come of it.
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        yield
        return
    handle, again = handler, list[threading.Timer]()

    def interrupt(signal_number: int, frame: FrameType | None) -> None:
        inner = frame
        while inner is not None:
            if inner.f_code in _UNDISTURBED or inner.f_code.co_filename == _UNDISTURBED_FILE:
                again.append(threading.Timer(0.01, _thread.interrupt_main, [signal_number]))
                again[-1].start()
                return
            inner = inner.f_back
        again.clear()
        handle(signal_number, frame)

    signal.signal(signal.SIGINT, interrupt)
    try:
        try:
            yield
        finally:
            # The last may still be on its way, and is due here.
            while again:
                again.pop().join()
    finally:
        signal.signal(signal.SIGINT, handler)


@contextmanager
def writing(path: Path, *, new: bool = False) -> Iterator[h5py.File]:
    """Open an HDF5 file to add to it, or, with ``new`` or where it is empty, to write it from its beginning.

    Raises:
        OSError: when something could not be written, at the latest when the file is closed.
    """
    new = new or path.stat().st_size == 0
    with polite_interrupts(), _QuietFile(path, "w+" if new else "r+") as raw:
        try:
            # Minari's own files remember the order in which episodes were added, too.
            with h5py.File(raw, "w" if new else "r+", track_order=True) as file:
                yield file
        except Exception:
            # What was not written cannot be read back, and HDF5 may have stumbled over that.
            if raw.failure is None:
                raise
        if raw.failure is not None:
            raise raw.failure
