"""Critics with and without a context: those of the base are widened, and those that are told are folded."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from imujoco_minari.policies import Array
from imujoco_minari.training.agents import CRITICS
from imujoco_minari.variants import specification

# The epsilon of SBX's batch normalisation.
_EPSILON = 1e-3
_KERNEL, _BIAS = (f"qf/params/VmapCritic_0/Dense_0/{name}" for name in ("kernel", "bias"))
_STATISTICS = "qf/batch_stats/VmapCritic_0/BatchRenorm_0"
_SCALING = "qf/params/VmapCritic_0/BatchRenorm_0"


def with_context(agent: Mapping[str, Array], contexts: Array, robot: str) -> dict[str, Array]:
    """Return critics of observation, context and action.

    Args:
        agent: the arrays of an agent. Critics that have the context already stay as they are.
        contexts: of the listed variants; shape (variants, parameters).
        robot: the robot.
    """
    page = specification(robot)
    size, count = page.observation_size + page.action_size, contexts.shape[1]
    arrays = {}
    for name, array in agent.items():
        if not name.startswith(CRITICS):
            continue
        arrays[name] = array
        if array.ndim > 1 and array.shape[1] == size:
            # Rows of the context, between those of the observation and of the action.
            before, after = np.split(array, [page.observation_size], axis=1)
            rows = np.zeros((array.shape[0], count, *array.shape[2:]), array.dtype)
            if name.endswith("scale"):
                rows += 1
            elif name.endswith("/mean"):
                rows += contexts.mean(axis=0)
            elif name.endswith("/var"):
                rows += np.maximum(contexts.var(axis=0), 1e-3)
            arrays[name] = np.concatenate([before, rows, after], axis=1)
    return arrays


def fold_critics(robot: str, told: Array, arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Return the critics that are told a context, as critics of observation and action alone.

    The normalised context is constant, so its part of the first layer is a constant that is added to the
    bias: exact with the normalisation's running statistics, which critics use when they judge.
    """
    first = specification(robot).observation_size
    rows = slice(first, first + len(told))
    mean, var = (arrays[f"{_STATISTICS}/{name}"][:, rows].astype(np.float64) for name in ("mean", "var"))
    scale, bias = (arrays[f"{_SCALING}/{name}"][:, rows].astype(np.float64) for name in ("scale", "bias"))
    normalised = (told - mean) / np.sqrt(var + _EPSILON) * scale + bias
    size = arrays[_KERNEL].shape[1]
    constant = np.einsum("cn,cnh->ch", normalised, arrays[_KERNEL][:, rows].astype(np.float64))
    folded = {}
    for name, array in arrays.items():
        if name.startswith(CRITICS):
            if array.ndim > 1 and array.shape[1] == size:
                array = np.delete(array, np.r_[rows], axis=1)
            folded[name] = array.astype(np.float32) if array.dtype == np.float16 else array
    folded[_BIAS] = (arrays[_BIAS] + constant).astype(np.float32)
    return folded
