"""D4RL's flat HDF5: arrays of N steps, floats in float32.

D4RL's own ``qlearning_dataset`` takes row i + 1 for the next observation, so it must drop the rows that
``timeouts`` marks, and it loses the last row; ``next_observations`` has what it misses. An episode's last
step is in ``terminals`` or in ``timeouts``, never in both and never in neither, so no boundary is lost.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imujoco_minari.loading.load import Arrays
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
        # As attributes: D4RL's sequence_dataset takes N entries of whatever array there is.
        file.attrs["variants"] = [origin.variant for origin in data.table]
        file.attrs["tiers"] = [origin.tier for origin in data.table]
