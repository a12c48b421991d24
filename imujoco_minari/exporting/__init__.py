"""Datasets as the files and in-memory objects of other libraries.

:func:`export` writes files, with one module for each format; :func:`export_archive` writes the layout of the
original's archive. The ``to_...`` functions return objects.
:mod:`imujoco_minari.exporting.torch` requires PyTorch, so it is imported separately.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imujoco_minari.errors import DatasetError, FormatError, unknown
from imujoco_minari.exporting import lerobot, rlds
from imujoco_minari.exporting.adapters import to_d3rlpy, to_imitation, to_tensordict, to_tianshou, to_torchrl
from imujoco_minari.exporting.flat import write_d4rl, write_di_engine, write_npz
from imujoco_minari.loading import Arrays, Datasets, arrays
from imujoco_minari.storage.targets import new_target

__all__ = [
    "FORMATS",
    "Exported",
    "default_target",
    "export",
    "export_archive",
    "to_d3rlpy",
    "to_imitation",
    "to_tensordict",
    "to_tianshou",
    "to_torchrl",
]

# Format -> the function that writes it, and the file name extension; empty for a folder.
FORMATS: Mapping[str, tuple[Callable[..., None], str]] = {
    "d4rl": (write_d4rl, ".hdf5"),
    "di-engine": (write_di_engine, ".hdf5"),
    "rlds": (rlds.write, ""),
    "lerobot": (lerobot.write, ""),
    "npz": (write_npz, ".npz"),
}
# The format of :func:`export_archive`, for the command line.
ARCHIVE = "imujoco"


@dataclass(frozen=True)
class Exported:
    """The result of an export: its path and format, and the number of episodes and steps."""

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
    """Write datasets of one robot as a file or folder that another library reads.

    Args:
        data: arrays, or datasets or their ids.
        format: ``d4rl``, ``di-engine``, ``rlds``, ``lerobot`` or ``npz``.
        target: the file or folder to make.
        states_only: omit actions and rewards, for imitation from observation.
        force: replace ``target`` if it is an export; nothing else is ever replaced.

    Raises:
        FormatError: when the format is unknown.
        DatasetError: when :func:`~imujoco_minari.loading.arrays` refuses the data.
        DatasetExistsError: when ``target`` exists, and ``force`` is false or it is no export.
        DependencyError: when the format needs a package that is not installed.
        StorageError: when ``target`` cannot be written.

    Example:
        >>> export("imujoco/hopper-base-v0", "d4rl", "hopper-base.hdf5")  # doctest: +SKIP
        Exported(path=PosixPath('hopper-base.hdf5'), format='d4rl', episodes=100, steps=100000)
    """
    target = Path(target)
    write, _ = _known(format)
    with new_target(target, force=force) as staged:
        if not isinstance(data, Arrays):
            data = arrays(data)
        write(data, staged, states_only=states_only)
    return Exported(target, format, data.episodes, len(data))


def export_archive(
    dataset_ids: str | Sequence[str],
    target: Path | str,
    *,
    force: bool = False,
    on_dataset: Callable[[], None] = lambda: None,
) -> Exported:
    """Write datasets as the original's archive: folders ``dataset``, ``policies`` and ``xml``.

    The datasets may be of several robots. They are loaded one at a time.

    Args:
        dataset_ids: ids of datasets, one for each variant, each made by one installed policy.
        target: the folder to make.
        force: replace ``target`` if it is an export; nothing else is ever replaced.
        on_dataset: called after each dataset.

    Raises:
        DatasetError: when two datasets are of one variant, or another policy or version made a dataset.
        DatasetExistsError: when ``target`` exists, and ``force`` is false or it is no export.
        DatasetNotFoundError: when a dataset is not in the Minari root.
        PolicyNotFoundError: when no single policy makes the tier of a dataset.
        StorageError: when ``target`` cannot be written.

    Example:
        >>> export_archive(["imujoco/hopper-massdec_25_leggeom-v0"], "imujoco")  # doctest: +SKIP
        Exported(path=PosixPath('imujoco'), format='imujoco', episodes=100, steps=100000)
    """
    from imujoco_minari.exporting import imujoco

    target = Path(target)
    dataset_ids = [dataset_ids] if isinstance(dataset_ids, str) else dataset_ids
    with new_target(target, force=force) as staged:
        episodes, steps = imujoco.write(dataset_ids, staged, on_dataset)
    return Exported(target, ARCHIVE, episodes, steps)


def default_target(dataset_id: str, format: str, *, states_only: bool = False) -> Path:
    """Return the default path of an export, ``<name>-<format>`` in the current folder."""
    _, extension = _known(format)
    states = "-states" if states_only else ""
    return Path(f"{dataset_id.rpartition('/')[2]}-{format}{states}{extension}")


def _known(format: Any) -> tuple[Callable[..., None], str]:
    """Return the entry of a format in :data:`FORMATS`."""
    if format == ARCHIVE:
        raise DatasetError(f"the format {ARCHIVE} is a folder of many datasets: see export_archive()")
    if not isinstance(format, str) or format not in FORMATS:
        raise FormatError(unknown("unknown format", format, (*FORMATS, ARCHIVE)))
    return FORMATS[format]
