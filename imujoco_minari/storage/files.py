"""Files that are complete or absent: they are written under a temporary name and then renamed."""

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
    """Yield a temporary path to write to. The file is renamed to ``path`` at the end, unless an error occurs.

    Raises:
        StorageError: if the file cannot be written.
    """
    # The suffix stays, because some writers choose the format by it.
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
    """Write a text file in one step.

    Raises:
        StorageError: if the file cannot be written.
    """
    with whole_file(path) as partial:
        partial.write_text(text, "utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write a value to a JSON file in one step.

    Raises:
        StorageError: if the file cannot be written.
    """
    write_text(path, json.dumps(value, indent=1) + "\n")
