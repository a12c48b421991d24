"""Where an export goes: written beside its place and renamed when it is whole."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from imujoco_minari.errors import DatasetExistsError, StorageError


@contextmanager
def new_target(target: Path, *, force: bool = False) -> Iterator[Path]:
    """Yield a path to write a file or folder to, which gets the name ``target`` at the end if all went well.

    Raises:
        DatasetExistsError: when ``target`` is there already and ``force`` is false.
        StorageError: when it cannot be written.
    """
    if target.exists() and not force:
        raise DatasetExistsError(f"{target} is already there; it was left alone (--force replaces it)")
    staging = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=f".{target.name[:80]}-", dir=target.parent))
        yield staging / target.name
        if target.is_dir():
            target.rename(staging / "replaced")
        (staging / target.name).replace(target)
    except OSError as error:
        # An error of ours may be a builtin of this kind too, and says more.
        if type(error).__module__ != OSError.__module__:
            raise
        raise StorageError(f"cannot write {target}: {error.strerror or error}") from None
    finally:
        if staging is not None:
            shutil.rmtree(staging, ignore_errors=True)
