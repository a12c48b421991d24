"""DI-engine's flat HDF5, as its ``HDF5Dataset`` reads it: each top-level key is an array of N steps.

``done`` marks terminations, because DI-engine does not bootstrap where it is set. The export loses
truncations: every transition is complete, but the boundaries of truncated episodes are not stored.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imujoco_minari.errors import DatasetError
from imujoco_minari.loading import Arrays
from imujoco_minari.storage.quiet_file import safe_point, writing


def write(data: Arrays, target: Path, *, states_only: bool) -> None:
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
        for name, column in columns.items():
            safe_point()
            file.create_dataset(name, data=column.astype(np.float32))
