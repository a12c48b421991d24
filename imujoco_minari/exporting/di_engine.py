"""DI-engine's flat HDF5, as its ``HDF5Dataset`` reads it: every key at the top is an array of N steps.

``done`` is a termination: DI-engine does not bootstrap where it is set. What is lost is where an episode
was truncated, so steps stay whole transitions but episodes cannot all be told apart.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from imujoco_minari.arrays import Arrays


def write(data: Arrays, target: Path, *, states_only: bool) -> None:
    """Write ``data`` to the HDF5 file ``target``."""
    columns = {
        "obs": data.observations,
        "next_obs": data.next_observations,
        "done": data.terminations,
    }
    if not states_only:
        columns |= {"action": data.actions, "reward": data.rewards}
    with h5py.File(target, "w") as file:
        for name, column in columns.items():
            file.create_dataset(name, data=column.astype(np.float32))
