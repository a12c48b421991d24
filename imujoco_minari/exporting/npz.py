"""The original benchmark's layout: a ``.npz`` with one float64 array ``data``, one row for each step.

Columns: observation, action, reward, next observation, done (terminated or truncated). The original's reader
takes observation and action from the first columns and done from the last. The original does not document the
columns between them. The export loses whether an episode was terminated or truncated.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.loading import Arrays


def write(data: Arrays, target: Path, *, states_only: bool) -> None:
    """Write ``data`` to the file ``target``; ``states_only`` omits actions and rewards."""
    if states_only:
        write_table(data, target, data.observations, data.next_observations)
    else:
        write_table(data, target, data.observations, data.actions, data.rewards, data.next_observations)


def write_table(data: Arrays, target: Path, *columns: Any) -> None:
    """Write columns of ``data``, and done as the last one."""
    done = np.zeros(len(data))
    done[data.episode_ends - 1] = 1.0
    # savez would add an extension to the staged file's name, but not to an open file.
    with target.open("wb") as file:
        np.savez(file, data=np.column_stack((*columns, done)))
