"""Files that are there whole or not at all: written beside their place and renamed into it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from imujoco_minari.errors import StorageError


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a partial name beside ``path``, which takes its place at the end unless there was an error.

    Raises:
        StorageError: when the place cannot be written.
    """
    # The ending stays, as some writers take the format from it.
    partial = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.replace(path)
    except OSError as error:
        if isinstance(error, StorageError):
            raise
        raise StorageError(f"cannot write {path}: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            partial.unlink()


def write_text(path: Path, text: str) -> None:
    """Write a text file whole.

    Raises:
        StorageError: when the place cannot be written.
    """
    with whole_file(path) as partial:
        partial.write_text(text, "utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write a value as JSON, whole.

    Raises:
        StorageError: when the place cannot be written.
    """
    write_text(path, json.dumps(value, indent=1) + "\n")
