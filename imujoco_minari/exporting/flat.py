"""Flat files, one row for each step: D4RL's HDF5, DI-engine's HDF5, and the table of the original benchmark.

**D4RL.** Floats are float32. The last step of each episode is marked in either ``terminals`` or ``timeouts``,
so no boundary is lost. D4RL's own ``qlearning_dataset`` takes row i + 1 as the next observation. It therefore
drops the rows that ``timeouts`` marks, and the last row; ``next_observations`` has what it drops.

**DI-engine.** What its ``HDF5Dataset`` reads. Every column is float32. ``done`` marks terminations, because
DI-engine does not bootstrap where it is set. The boundaries of truncated episodes are not stored.

**The table.** A ``.npz`` with one float64 array ``data``. The original's reader takes observation and action
from the first columns and done from the last. The original does not document the columns between them. The
export loses whether an episode was terminated or truncated; the table of an archive keeps it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import DatasetError
from imujoco_minari.loading import Arrays
from imujoco_minari.storage.quiet_file import safe_point, writing

# The columns of a table. Done is 1 in the last row of an episode.
TABLE = ("observation", "action", "reward", "next_observation", "done")
ARCHIVE_TABLE = (*TABLE[:-1], "terminated", "done")


def write_d4rl(data: Arrays, target: Path, *, states_only: bool) -> None:
    """Write ``data`` to the HDF5 file ``target``."""
    columns = {
        "observations": data.observations.astype(np.float32),
        "next_observations": data.next_observations.astype(np.float32),
        "terminals": data.terminations,
        "timeouts": _last_steps(data) & ~data.terminations,
    }
    if not states_only:
        columns["actions"] = data.actions.astype(np.float32)
        columns["rewards"] = data.rewards.astype(np.float32)
    with writing(target, new=True) as file:
        _write_columns(file, columns.items())
        file["infos/variant_index"] = data.variant_index
        # These are attributes because D4RL's sequence_dataset expects N entries in every array.
        file.attrs["variants"] = [origin.variant for origin in data.table]
        file.attrs["tiers"] = [origin.tier for origin in data.table]


def write_di_engine(data: Arrays, target: Path, *, states_only: bool) -> None:
    """Write ``data`` to the HDF5 file ``target``.

    Raises:
        DatasetError: with ``states_only``, because DI-engine's reader requires actions.
    """
    if states_only:
        raise DatasetError(
            "DI-engine's HDF5Dataset requires actions; valid for states only: d4rl, rlds, lerobot, npz"
        )
    columns = {
        "obs": data.observations,
        "next_obs": data.next_observations,
        "action": data.actions,
        "reward": data.rewards,
        "done": data.terminations,
    }
    with writing(target, new=True) as file:
        _write_columns(file, ((name, column.astype(np.float32)) for name, column in columns.items()))


def write_npz(data: Arrays, target: Path, *, states_only: bool) -> None:
    """Write ``data`` as a table to the file ``target``; ``states_only`` omits actions and rewards."""
    omitted = ("action", "reward") if states_only else ()
    write_table(data, target, [name for name in TABLE if name not in omitted])


def write_table(data: Arrays, target: Path, columns: Sequence[str]) -> None:
    """Write the named columns of ``data`` to the file ``target``."""
    arrays = {
        "observation": data.observations,
        "action": data.actions,
        "reward": data.rewards,
        "next_observation": data.next_observations,
        "terminated": data.terminations,
        "done": _last_steps(data),
    }
    # savez would add an extension to the staged file's name, but not to an open file.
    with target.open("wb") as file:
        np.savez(file, data=np.column_stack([arrays[name] for name in columns]))


def _last_steps(data: Arrays) -> NDArray[Any]:
    return np.isin(np.arange(len(data)), data.episode_ends - 1)


def _write_columns(file: h5py.File, columns: Iterable[tuple[str, NDArray[Any]]]) -> None:
    for name, column in columns:
        safe_point()
        file.create_dataset(name, data=column)
