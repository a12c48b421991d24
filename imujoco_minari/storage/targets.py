"""Where an export goes: written beside its place and renamed when it is whole."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from imujoco_minari.errors import DatasetExistsError, StorageError
from imujoco_minari.storage import minari_root

_PREFIX = ".imujoco-export-"


@contextmanager
def new_target(target: Path, *, force: bool = False) -> Iterator[Path]:
    """Yield a path to write a file or folder to, which gets the name ``target`` at the end if all went well.

    Raises:
        DatasetExistsError: when ``target`` is there already and ``force`` is false.
        StorageError: when it cannot be written.
    """
    if target.exists() and not force:
        raise DatasetExistsError(f"{target} is already there; it was left alone (--force replaces it)")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with minari_root.scratch(target.parent, _PREFIX) as staging:
            yield staging / target.name
            _put(staging / target.name, target)
    except OSError as error:
        # An error of ours may be a builtin of this kind too, and says more.
        if type(error).__module__ != OSError.__module__:
            raise
        raise StorageError(f"cannot write {target}: {error.strerror or error}") from None


def _put(new: Path, target: Path) -> None:
    """Give ``new`` the name of ``target``; what has it now goes into the folder that ``new`` was in."""
    if not target.is_dir():
        new.replace(target)
    elif not minari_root.exchange(new, target):
        # Where a system cannot swap folders, the old one comes back if the new one does not get in.
        old = new.with_name(".old")
        target.rename(old)
        try:
            new.rename(target)
        except BaseException:
            old.rename(target)
            raise
