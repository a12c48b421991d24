"""DI-engine's flat HDF5, as its ``HDF5Dataset`` reads it: every key at the top is an array of N steps.

``done`` is a termination: DI-engine does not bootstrap where it is set. What is lost is where an episode
was truncated, so steps stay whole transitions but episodes cannot all be told apart.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imujoco_minari.errors import DatasetError
from imujoco_minari.loading.load import Arrays
from imujoco_minari.storage.quiet_file import safe_point, writing


def write(data: Arrays, target: Path, *, states_only: bool) -> None:
    """Write ``data`` to the HDF5 file ``target``.

    Raises:
        DatasetError: with ``states_only``; DI-engine's reader fails without actions.
    """
    if states_only:
        raise DatasetError(
            "DI-engine's HDF5Dataset needs actions: valid for states alone are d4rl, rlds, lerobot, npz"
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
