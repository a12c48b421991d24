"""HDF5 files, written so that a full disk and a Ctrl-C are ordinary errors.

**A full disk.** HDF5 cannot close a file whose last bytes it cannot write: it prints an error for every
open object, and the process crashes when it ends. So HDF5 writes to a Python file of this module. That file
keeps the first failure, and accepts and drops everything after it. The failure is raised once HDF5 has
closed the file.

**Ctrl-C.** Python calls the handler of SIGINT between any two lines of Python code, and the handler raises
KeyboardInterrupt. Within the Python file, the exception would have to pass through HDF5's C code, which
loses it. Within ``h5py.File.close``, it would leave a half-closed file. So while a file is open for
writing, a handler is installed that only notes the signal. The noted signal is raised at the next *safe
point*: a call of :func:`safe_point`, which the loops over steps and episodes make, or the end of
:func:`writing`.
"""

from __future__ import annotations

import io
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import h5py


class _InterruptNote:
    """A handler of SIGINT that notes the signal for the handler that it stands in for."""

    def __init__(self, handler: Callable[[int, FrameType | None], Any]) -> None:
        self._handler, self._noted = handler, False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self._noted = True

    def hand_on(self) -> None:
        """Call the other handler, which raises KeyboardInterrupt, if a signal was noted."""
        if self._noted and _in_main_thread():
            self._noted = False
            self._handler(signal.SIGINT, None)


# The handler that is installed, if one is.
_installed: list[_InterruptNote] = []


@contextmanager
def delayed_interrupts() -> Iterator[None]:
    """Delay a Ctrl-C to the next :func:`safe_point`, or to the end of the ``with`` block."""
    handler = signal.getsignal(signal.SIGINT)
    # Python handles signals in the main thread only. SIG_DFL and SIG_IGN raise nothing. Of nested blocks,
    # the outermost delays.
    if not _in_main_thread() or not callable(handler) or _installed:
        yield
        return
    note = _InterruptNote(handler)
    signal.signal(signal.SIGINT, note)
    _installed.append(note)
    try:
        yield
    finally:
        _installed.remove(note)
        signal.signal(signal.SIGINT, handler)
        note.hand_on()


def safe_point() -> None:
    """Raise the delayed Ctrl-C, if one came.

    Raises:
        KeyboardInterrupt: when a SIGINT came within :func:`delayed_interrupts`.
    """
    for note in _installed:
        note.hand_on()


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


class _QuietFile(io.FileIO):
    """A file whose writes never fail: it keeps the first failure, and drops everything after it."""

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
    """Open an HDF5 file to add to it, or to write it anew with ``new`` or when it is empty.

    A Ctrl-C is delayed until the file is closed or :func:`safe_point` is called.

    Raises:
        OSError: when something could not be written, at the latest when the file is closed.
    """
    new = new or path.stat().st_size == 0
    with delayed_interrupts(), _QuietFile(path, "w+" if new else "r+") as raw:
        try:
            # Minari's own files remember the order in which episodes were added, too.
            with h5py.File(raw, "w" if new else "r+", track_order=True) as file:
                yield file
        except Exception:
            # After a failed write, HDF5 cannot read back what was dropped, and raises errors of its own.
            if raw.failure is None:
                raise
        if raw.failure is not None:
            raise raw.failure
