"""The agent that a variant's training starts from: the folded one, or the base's where that scores higher.

The universal policy is told the variant, so its folded actor is the expert that the variant has without
training. Its critics are folded the same way. A robot without a universal policy starts from its base's
agent.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from imujoco_minari.errors import PolicyNotFoundError
from imujoco_minari.policies import Array, agent_file, own_record, universal_policy
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.experts import FOLDED
from imujoco_minari.policies.universal import UniversalPolicy, universal_name
from imujoco_minari.training.agents import actor_of, agent_actor, load_arrays, replace_actor
from imujoco_minari.training.run import score as score_of
from imujoco_minari.variants import Variant, specification

EPISODES, START_SEED = 5, 1_000_005
# The epsilon of SBX's batch normalisation.
_EPSILON = 1e-3
_KERNEL, _BIAS = (f"qf/params/VmapCritic_0/Dense_0/{name}" for name in ("kernel", "bias"))
_STATISTICS = "qf/batch_stats/VmapCritic_0/BatchRenorm_0"
_SCALING = "qf/params/VmapCritic_0/BatchRenorm_0"


@dataclass
class Start:
    """An agent to start from.

    Attributes:
        name: a base, or ``universal policy``.
        sha256: digest of its policy, from its record.
        agent: arrays of the agent.
        score: score of its evaluation on the variant; -inf if not evaluated.
    """

    name: str
    sha256: str
    agent: dict[str, Array] = field(repr=False)
    score: float = float("-inf")


def best_start(variant: Variant, policies: Path) -> Start:
    """Return the better start for a variant: the folded agent, or the base's.

    Args:
        variant: the variant.
        policies: folder to search before the package's.

    Raises:
        PolicyNotFoundError: if the base's agent does not exist.
    """
    record, path = own_record(variant.base, policies), agent_file(variant.base, policies)
    if not record or path is None:
        raise PolicyNotFoundError(
            f"{variant} starts from the agent of {variant.base}, which does not exist: run "
            f"`imujoco train {variant.base}` first, or train with --scratch"
        )
    base_agent = load_arrays(path)
    starts = [Start(str(variant.base), str(record["weights_sha256"]), base_agent)]
    universal = universal_policy(variant.robot, policies)
    if universal is not None:
        own = agent_file(universal_name(variant.robot), policies)
        critics = {} if own is None else fold_critics(universal, variant, load_arrays(own))
        actor = dict(universal.fold(variant).weights)
        starts.append(Start(FOLDED, universal.sha256, replace_actor(base_agent | critics, actor)))
    for start in starts:
        measured = evaluate(
            variant,
            actor_of(agent_actor(start.agent), variant.robot),
            episodes=EPISODES,
            seed=START_SEED,
        )
        start.score = score_of(measured.asdict())
    return max(starts, key=lambda start: start.score)


def fold_critics(
    universal: UniversalPolicy, variant: Variant, arrays: Mapping[str, Array]
) -> dict[str, Array]:
    """Return the critics that are told a variant, as critics of observation and action alone.

    The normalised context is constant, so its part of the first layer is a constant that is added to the
    bias: exact with the normalisation's running statistics, which critics use when they judge.

    Args:
        universal: the universal policy.
        variant: the variant.
        arrays: the arrays of its agent: the critics' parameters and statistics.
    """
    first = specification(variant.robot).observation_size
    told = universal.context(variant)
    rows = slice(first, first + len(told))
    mean, var = (arrays[f"{_STATISTICS}/{name}"][:, rows].astype(np.float64) for name in ("mean", "var"))
    scale, bias = (arrays[f"{_SCALING}/{name}"][:, rows].astype(np.float64) for name in ("scale", "bias"))
    normalised = (told - mean) / np.sqrt(var + _EPSILON) * scale + bias
    size = arrays[_KERNEL].shape[1]
    folded: dict[str, Array] = {
        name: np.delete(array, np.r_[rows], axis=1) if array.ndim > 1 and array.shape[1] == size else array
        for name, array in arrays.items()
        if name.startswith(("qf/", "entropy/"))
    }
    constant = np.einsum("cn,cnh->ch", normalised, arrays[_KERNEL][:, rows].astype(np.float64))
    folded[_BIAS] = (arrays[_BIAS] + constant).astype(np.float32)
    return {
        name: array.astype(np.float32) if array.dtype == np.float16 else array
        for name, array in folded.items()
    }
