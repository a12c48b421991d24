"""D4RL's flat HDF5: arrays of N steps, floats in float32.

The last step of each episode is marked in either ``terminals`` or ``timeouts``, so no boundary is lost.
D4RL's own ``qlearning_dataset`` takes row i + 1 as the next observation. It therefore drops the rows that
``timeouts`` marks, and the last row; ``next_observations`` has the observations that it drops.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imujoco_minari.loading import Arrays
from imujoco_minari.storage.quiet_file import safe_point, writing


def write(data: Arrays, target: Path, *, states_only: bool) -> None:
    """Write ``data`` to the HDF5 file ``target``."""
    last = np.zeros(len(data), bool)
    last[data.episode_ends - 1] = True
    columns = {
        "observations": data.observations.astype(np.float32),
        "next_observations": data.next_observations.astype(np.float32),
        "terminals": data.terminations,
        "timeouts": last & ~data.terminations,
    }
    if not states_only:
        columns["actions"] = data.actions.astype(np.float32)
        columns["rewards"] = data.rewards.astype(np.float32)
    with writing(target, new=True) as file:
        for name, column in columns.items():
            safe_point()
            file.create_dataset(name, data=column)
        file["infos/variant_index"] = data.variant_index
        # These are attributes because D4RL's sequence_dataset expects N entries in every array.
        file.attrs["variants"] = [origin.variant for origin in data.table]
        file.attrs["tiers"] = [origin.tier for origin in data.table]
