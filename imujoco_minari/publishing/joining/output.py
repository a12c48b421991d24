"""A file written block by block by one thread, while another takes its digest."""

from __future__ import annotations

import hashlib
import os
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

# Who checks the next file holds Python's lock for milliseconds. So long writing and digest must find work
# in what they have: blocks of 1 MiB take a tenth longer.
_BLOCK, _BLOCKS = 2**22, 4
# What Linux is given at a time. It caches in pieces as large as it is given, and has smaller ones at hand:
# with 4 MiB every third file takes half as long again.
_PIECE = 2**20
# So much is sent to the disk at a time, lest all of it wait for the end.
_SENT = 2**24


class Output:
    """A new file, open for writing while in a ``with``.

    Attributes:
        size: how many bytes were written, or will be soon.
    """

    size = 0

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)
        self._digest = hashlib.sha256()
        self._writer, self._digester = ThreadPoolExecutor(1), ThreadPoolExecutor(1)
        self._busy: deque[tuple[memoryview, Future[None], Future[None]]] = deque()
        self._made = self._sent = 0

    def __enter__(self) -> Output:
        return self

    def __exit__(self, *error: object) -> None:
        for thread in (self._writer, self._digester):
            thread.shutdown(cancel_futures=True)
        self._file.close()

    def block(self) -> memoryview:
        """Return memory to be filled and given to :meth:`write_block`.

        Raises:
            OSError: when something could not be written.
        """
        if self._made < _BLOCKS:
            self._made += 1
            return memoryview(bytearray(_BLOCK))
        return self._done()

    def write(self, data: bytes) -> None:
        """Write some bytes.

        Raises:
            OSError: when something could not be written.
        """
        for begin in range(0, len(data), _BLOCK):
            part = data[begin : begin + _BLOCK]
            block = self.block()
            block[: len(part)] = part
            self.write_block(block[: len(part)])

    def write_block(self, block: memoryview) -> None:
        """Write a block, or the beginning of one, which is not the caller's any more."""
        written = self._writer.submit(self._write, block)
        self.size += len(block)
        self._busy.append((block, written, self._digester.submit(self._digest.update, block)))

    def sha256(self) -> str:
        """Return the digest of the file, when all of it is written.

        Raises:
            OSError: when something could not be.
        """
        while self._busy:
            self._done()
        return self._digest.hexdigest()

    def _done(self) -> memoryview:
        block, *works = self._busy.popleft()
        for work in works:
            work.result()
        return memoryview(block.obj)

    def _write(self, rest: memoryview) -> None:
        try:
            while rest:
                rest = rest[self._file.write(rest[:_PIECE]) :]
        except OSError as error:
            error.filename = self._file.name
            raise
        waiting = self._file.tell() - self._sent
        if waiting >= _SENT and hasattr(os, "posix_fadvise"):
            # What Linux is told not to keep it begins to write to the disk, and keeps until it has.
            with suppress(OSError):
                os.posix_fadvise(self._file.fileno(), self._sent, waiting, os.POSIX_FADV_DONTNEED)
            self._sent += waiting
