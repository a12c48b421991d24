"""Agents with and without a context: the base's agent is widened, and critics that are told are folded."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from imujoco_minari.policies import Array
from imujoco_minari.training.agents import CRITICS, STARTING
from imujoco_minari.variants import specification

# The epsilon of SBX's batch normalisation.
_EPSILON = 1e-3
_ACTOR_KERNEL = "actor/params/Dense_0/kernel"
# The arrays of the critics' first layer whose second axis is the input.
_KERNEL, _BIAS = (f"qf/params/VmapCritic_0/Dense_0/{name}" for name in ("kernel", "bias"))
_MEAN, _VAR = (f"qf/batch_stats/VmapCritic_0/BatchRenorm_0/{name}" for name in ("mean", "var"))
_SCALE, _SHIFT = (f"qf/params/VmapCritic_0/BatchRenorm_0/{name}" for name in ("scale", "bias"))


def with_context(agent: Mapping[str, Array], contexts: Array, robot: str) -> dict[str, Array]:
    """Return an agent of the observation alone as one of observation and context, which ignores the context.

    Args:
        agent: the arrays of the agent.
        contexts: of the listed variants, which the critics' normalisation begins with; shape (variants,
            parameters).
        robot: the robot.
    """
    count, first = contexts.shape[1], specification(robot).observation_size
    arrays = {name: array for name, array in agent.items() if name.startswith(STARTING)}
    arrays[_ACTOR_KERNEL] = np.pad(arrays[_ACTOR_KERNEL], ((0, count), (0, 0)))
    added = {
        _KERNEL: np.zeros((count, 1)),
        _MEAN: contexts.mean(axis=0),
        _VAR: np.maximum(contexts.var(axis=0), 1e-3),
        _SCALE: np.ones(count),
        _SHIFT: np.zeros(count),
    }
    for name, rows in added.items():
        # Rows of the context, between those of the observation and of the action.
        before, after = np.split(arrays[name], [first], axis=1)
        rows = np.broadcast_to(rows, (len(before), count, *before.shape[2:])).astype(before.dtype)
        arrays[name] = np.concatenate([before, rows, after], axis=1)
    return arrays


def fold_critics(robot: str, told: Array, arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Return the critics that are told a context, as critics of observation and action alone.

    The normalised context is constant, so its part of the first layer is a constant that is added to the
    bias: exact with the normalisation's running statistics, which critics use when they judge.
    """
    first = specification(robot).observation_size
    rows = slice(first, first + len(told))
    mean, var, scale, shift, kernel = (
        arrays[name][:, rows].astype(np.float64) for name in (_MEAN, _VAR, _SCALE, _SHIFT, _KERNEL)
    )
    normalised = (told - mean) / np.sqrt(var + _EPSILON) * scale + shift
    folded = {name: array for name, array in arrays.items() if name.startswith(CRITICS)}
    for name in (_MEAN, _VAR, _SCALE, _SHIFT, _KERNEL):
        folded[name] = np.delete(arrays[name], np.r_[rows], axis=1)
    folded[_BIAS] = (arrays[_BIAS] + np.einsum("cn,cnh->ch", normalised, kernel)).astype(np.float32)
    return folded
