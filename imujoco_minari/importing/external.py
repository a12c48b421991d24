"""Import of data from Minari, D4RL's HDF5 files and ``.npz`` files as a tier of a variant.

Only plain arrays are read. Nothing is unpickled or executed, no environment of the data is made, and links
to other files are not followed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from imujoco_minari.envs.mjcf import canonical_mjcf
from imujoco_minari.envs.registration import environment_spec
from imujoco_minari.errors import DatasetError, DatasetNotFoundError, ImujocoError
from imujoco_minari.importing.columns import ARRAY, read_table
from imujoco_minari.importing.physics import Physics
from imujoco_minari.importing.safe_unpack import Allowance, Array, read_npz
from imujoco_minari.importing.transitions import QUANTITIES, Fidelity, Transitions, cut
from imujoco_minari.policies.references import reference_scores
from imujoco_minari.publishing.new_dataset import NewDataset, publish_episodes
from imujoco_minari.publishing.outcome import Published
from imujoco_minari.storage import containment, file_format, minari_root
from imujoco_minari.storage.metadata import provenance, read_metadata, texts
from imujoco_minari.variants import Variant
from imujoco_minari.verification.child_process import survives_walk


@dataclass(frozen=True)
class ExternalData:
    """The content of a source.

    Attributes:
        kind: the kind of the source, for the description.
        transitions: its steps.
        columns: the layout of its table; empty when its arrays have names.
        algorithm: the algorithm that it states, or an empty string.
        authors: the authors that it states.
    """

    kind: str
    transitions: Transitions
    columns: str = ""
    algorithm: str = ""
    authors: tuple[str, ...] = ()


@dataclass(frozen=True)
class Imported:
    """The outcome of an import, and the difference between its steps and the variant's simulation."""

    published: Published
    one_step: Fidelity
    notes: tuple[str, ...]


def import_dataset(
    source: str, variant: Variant, tier: str, *, columns: str | None = None, force: bool = False
) -> Imported:
    """Publish data from elsewhere as a tier of one of our variants.

    Args:
        source: a Minari dataset's id or folder, or an HDF5 (D4RL's layout) or ``.npz`` file.
        variant: the variant that the data belong to.
        tier: the tier of the published dataset.
        columns: the columns of the table of an ``.npz`` file, when the user states them.
        force: replace a dataset that has the id.

    Raises:
        ImujocoError: when the source is missing, malformed or too large, or does not fit the robot.
    """
    dataset_id = variant.dataset_id(tier)
    read = read_source(source, variant.robot, columns)
    if columns is not None and not read.columns:
        raise DatasetError(f"{source}: is {read.kind} whose arrays have names: leave out --columns")
    spec = environment_spec(variant)
    with Physics(spec) as physics:
        found = cut(read.transitions, physics)
        near = found.fidelity()
        metadata = {
            **provenance(
                authors=read.authors or ("unknown",),
                algorithm=read.algorithm or "unknown",
                description=" ".join(
                    (
                        f"Imported {read.kind}, {Path(source).name[:100]}, as the tier {tier} of {variant}: "
                        f"{len(found.bounds)} episodes, {len(read.transitions)} steps. "
                        "No seeds are known that would replay them in this variant's environment.",
                        *found.notes,
                    )
                ),
            ),
            "source": Path(source).name[:200],
            "one_step_difference": vars(near),
            **({"source_columns": read.columns} if read.columns else {}),
            **reference_scores(variant),
        }
        attributes = file_format.attributes(variant, tier) | {file_format.REPLAYABLE: False}
        dataset = NewDataset(dataset_id, attributes, canonical_mjcf(variant), metadata)
        published = publish_episodes(dataset, spec, found.episodes(), force=force)
    return Imported(published, near, found.notes)


def read_source(source: str, robot: str, columns: str | None = None) -> ExternalData:
    """Return the steps of a source that :func:`import_dataset` takes.

    Raises:
        ImujocoError: when it is missing, malformed or too large, or does not fit the robot.
    """
    path = Path(source)
    if path.is_dir():
        return _minari(path, robot)
    if path.is_file():
        if path.suffix == ".npz":
            return _npz(path, robot, columns)
        if h5py.is_hdf5(path):
            return _d4rl(path, robot)
        raise DatasetError(
            f"{source}: neither .npz nor HDF5; valid: a Minari dataset, a D4RL HDF5 file, an .npz file"
        )
    try:
        folder = minari_root.dataset_folder(source)
    except ImujocoError:
        raise DatasetNotFoundError(f"{source[:200]}: no such file, folder or dataset") from None
    if not folder.is_dir():
        raise DatasetNotFoundError(
            f"{source} is neither a file nor in the Minari root, at {folder}; "
            f"`minari download {source}` fetches a dataset of Minari's"
        )
    return _minari(folder, robot)


def _npz(path: Path, robot: str, columns: str | None) -> ExternalData:
    arrays = read_npz(path)
    if ARRAY in arrays:
        transitions, layout, _ = read_table(arrays[ARRAY], robot, str(path), columns)
        return ExternalData("an .npz table", transitions, str(layout))
    return ExternalData("an .npz file", _flat(arrays, robot, str(path)))


def _d4rl(path: Path, robot: str) -> ExternalData:
    allowance = Allowance()
    with _opened(path) as file:
        known = [name for quantity in QUANTITIES.values() for name in quantity.names if name in file]
        arrays = {name: _array(file, name, str(path), allowance) for name in known}
        if not arrays and "episode_0" in file:
            raise DatasetError(f"{path}: is a Minari dataset's file: give the dataset's folder, or its id")
    return ExternalData("a D4RL HDF5 file", _flat(arrays, robot, str(path)))


def _flat(arrays: Mapping[str, Array], robot: str, name: str) -> Transitions:
    """Return the transitions of arrays of one length, under any of their known names."""
    found: dict[str, Array] = {}
    for field, quantity in QUANTITIES.items():
        known = [word for word in quantity.names if word in arrays]
        if known:
            found[field] = arrays[known[0]]
    if not {"observations", "actions"} <= set(found):
        seen = ", ".join(sorted(arrays))[:200] or "no array of a known name"
        raise DatasetError(f"{name}: has no observations and actions, but {seen}")
    flags = [found[field] for field in ("terminations", "truncations", "ends") if field in found]
    if not flags:
        raise DatasetError(f"{name}: nothing says where episodes end; valid: terminals, timeouts, dones")
    steps = Transitions(**({"ends": flags[0]} | found)).checked(robot, name)
    ends = [array for array in (steps.terminations, steps.truncations, steps.ends) if array is not None]
    return replace(steps, ends=np.any(ends, axis=0))


def _minari(folder: Path, robot: str) -> ExternalData:
    data = folder / "data" if (folder / "data").is_dir() else folder
    path = file_format.main_file(data)
    if not path.is_file():
        raise DatasetError(
            f"{folder}: holds no Minari dataset in HDF5, no {file_format.MAIN_FILE}; "
            "`imujoco import-archive` reads the original's archive"
        )
    metadata = read_metadata(data)
    parts, allowance = [], Allowance()
    with _opened(path) as file:
        for number in range(len(file)):
            name = f"episode_{number}"
            group = _own(file, name)
            if not isinstance(group, h5py.Group):
                raise DatasetError(f"{folder}: {name} is missing, or lies in another file")
            parts.append(_episode(group, f"{folder}: {name}", robot, allowance))
    if not parts:
        raise DatasetError(f"{folder}: holds no episode")
    names = [field.name for field in fields(Transitions)]
    return ExternalData(
        "a Minari dataset",
        Transitions(*(np.concatenate([getattr(part, name) for part in parts]) for name in names)),
        algorithm=str(metadata.get("algorithm_name") or "")[:100],
        authors=tuple(author[:100] for author in texts(metadata, "author")[:20]),
    )


def _episode(group: h5py.Group, name: str, robot: str, allowance: Allowance) -> Transitions:
    arrays = {key: _array(group, key, name, allowance) for key in file_format.ARRAYS}
    observations, length = arrays["observations"], len(arrays["rewards"])
    if len(observations) != length + 1 or not length:
        raise DatasetError(f"{name}: has {len(observations)} observations for {length} steps, not one more")
    return Transitions(
        observations=observations[:-1],
        actions=arrays["actions"],
        ends=np.arange(length) == length - 1,
        terminations=arrays["terminations"],
        truncations=arrays["truncations"],
        rewards=arrays["rewards"],
        next_observations=observations[1:],
    ).checked(robot, name)


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    if finding := survives_walk(path):
        raise DatasetError(f"{path}: {finding.what}")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except ImujocoError:
        raise
    except (OSError, KeyError, RuntimeError, ValueError, TypeError) as error:
        raise DatasetError(f"{path}: cannot be read as HDF5: {' '.join(str(error).split())[:200]}") from None


def _array(group: h5py.Group, name: str, where: str, allowance: Allowance) -> Array:
    """Return one array of an HDF5 group, checked before it is read."""
    array = _own(group, name)
    if not isinstance(array, h5py.Dataset):
        raise DatasetError(f"{where}: {name} is not an array of this file")
    containment.check_array(array.id, f"{where}: {name}")
    if array.shape is None or array.dtype.kind not in "fiub":
        raise DatasetError(f"{where}: {name} holds {str(array.dtype)[:40]}, not numbers")
    # HDF5 reads a whole chunk, which may be larger than the array.
    chunk = array.chunks or (0,)
    allowance.take(max(array.size, math.prod(chunk)), f"{where}: {name}")
    if not _is_stored(array):
        raise DatasetError(f"{where}: {name} claims {array.size} numbers, more than the file stores")
    return np.asarray(array[()])


def _own(group: h5py.Group, name: str) -> Any:
    """Return an item of a group; None if it is missing or a link."""
    return group.get(name) if isinstance(group.get(name, getlink=True), h5py.HardLink) else None


def _is_stored(array: h5py.Dataset) -> bool:
    """Return whether the file stores all values of an array; HDF5 reads the others as fill values."""
    if array.chunks is None:
        return bool(array.id.get_storage_size() >= array.nbytes)
    # The chunks may be compressed, so their size does not show it.
    chunks = math.prod(
        math.ceil(length / step) for length, step in zip(array.shape, array.chunks, strict=True)
    )
    return bool(array.id.get_num_chunks() >= chunks)
