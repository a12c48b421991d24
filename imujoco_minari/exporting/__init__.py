"""Datasets as the files of other libraries: one module a format, one function for all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

from imujoco_minari.errors import DatasetError, suggestion
from imujoco_minari.loading.load import Arrays, arrays
from imujoco_minari.storage.targets import new_target

if TYPE_CHECKING:
    from imujoco_minari.loading.selection import Datasets

# Format -> the module that writes it, and the ending of the file; empty for a folder.
FORMATS: Mapping[str, tuple[str, str]] = {
    "d4rl": ("d4rl", ".hdf5"),
    "di-engine": ("di_engine", ".hdf5"),
    "rlds": ("rlds", ""),
    "lerobot": ("lerobot", ""),
    "npz": ("npz", ".npz"),
}


class Writer(Protocol):
    """What each format's module is."""

    def write(self, data: Arrays, target: Path, *, states_only: bool) -> None:
        """Write all of ``data`` to the new file or folder ``target``."""


@dataclass(frozen=True)
class Exported:
    """What was written: where, in which format, how much."""

    path: Path
    format: str
    episodes: int
    steps: int


def export(
    data: Arrays | Datasets,
    format: str,
    target: Path | str,
    *,
    states_only: bool = False,
    force: bool = False,
) -> Exported:
    """Write datasets as a file or folder that another library reads.

    Args:
        data: arrays (loaded as stored, or chosen and split as you like), or datasets or their ids.
        format: ``d4rl``, ``di-engine``, ``rlds``, ``lerobot`` or ``npz``.
        target: the file or folder to make.
        states_only: leave actions and rewards out, for imitation from observation.
        force: replace a file or folder of that name, if it is an export; nothing else is replaced.

    Raises:
        DatasetError: when there is no such format.
        DatasetExistsError: when ``target`` is there already, and ``force`` is false or it is no export.
        DependencyError: when the format needs a package that is not installed.
        StorageError: when ``target`` cannot be written.
    """
    target = Path(target)
    writer = _writer(format)
    with new_target(target, force=force) as staged:
        if not isinstance(data, Arrays):
            data = arrays(data)
        writer.write(data, staged, states_only=states_only)
    return Exported(target, format, data.episodes, len(data))


def default_target(dataset_id: str, format: str, *, states_only: bool = False) -> Path:
    """Return the name that an export gets when none is given, ``<name>-<format>``, in the present folder."""
    _writer(format)
    name = dataset_id.rpartition("/")[2] + f"-{format}" + ("-states" if states_only else "")
    return Path(name + FORMATS[format][1])


def _writer(format: str) -> Writer:
    if format not in FORMATS:
        raise DatasetError(
            f"unknown format {format[:80]!r}{suggestion(format[:80], FORMATS)}; valid: {', '.join(FORMATS)}"
        )
    module: Any = import_module(f"imujoco_minari.exporting.{FORMATS[format][0]}")
    return cast(Writer, module)
