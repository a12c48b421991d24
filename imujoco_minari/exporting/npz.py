"""The original benchmark's layout: a ``.npz`` with one array ``data``, one row a step, in float64.

Columns: observation, action, reward, next observation, done. Observation and action come first and done
(terminated or truncated) last, as the original's reader takes them; what lies between its users never
documented. That an episode was truncated rather than terminated is lost.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imujoco_minari.loading import Arrays


def write(data: Arrays, target: Path, *, states_only: bool) -> None:
    """Write ``data`` to the file ``target``; with ``states_only`` observation, next observation and done."""
    done = np.zeros(len(data))
    done[data.episode_ends - 1] = 1.0
    columns = [data.observations, data.actions, data.rewards, data.next_observations, done]
    if states_only:
        columns = [data.observations, data.next_observations, done]
    # Through an open file, since savez would add an ending to the name of the staged one.
    with target.open("wb") as file:
        np.savez(file, data=np.column_stack(columns))
