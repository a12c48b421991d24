"""What a variant's training starts from: the base's agent, or the generalist's where that does better on it.

A generalist is one agent trained over all variants of a robot. It is nobody's expert, as it cannot know
in which variant it walks; but on a far variant it falls less than the base's does.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gymnasium import Env

from imujoco_minari.errors import PolicyNotFoundError
from imujoco_minari.policies import Array, agent_file, expert_record
from imujoco_minari.registration import make
from imujoco_minari.rollouts import evaluate
from imujoco_minari.training.agents import actor_of, agent_actor, load_arrays
from imujoco_minari.training.hyperparameters import WARM, hyperparameters
from imujoco_minari.variants import Variant

START_SEED = 1_000_005


@dataclass(frozen=True)
class Start:
    """An agent to start from: its name, the digest of its actor as its record has it, its arrays."""

    name: str
    sha256: str
    agent: dict[str, Array] = field(repr=False)


def generalist_name(robot: str) -> str:
    """Return the name of a robot's generalist, ``<robot>-all``."""
    return f"{robot}-all"


def generalist_record(robot: str, policies: Path | None = None) -> dict[str, Any]:
    """Return the training record of a robot's generalist; empty when there is none."""
    path = agent_file(generalist_name(robot), policies)
    return {} if path is None else json.loads(path.with_suffix(".json").read_text("utf-8"))


def base_start(variant: Variant, policies: Path | None = None) -> Start:
    """Return the agent of a variant's base.

    Raises:
        PolicyNotFoundError: when it is not there.
    """
    record, path = expert_record(variant.base, policies), agent_file(variant.base, policies)
    if not record or path is None:
        raise PolicyNotFoundError(
            f"{variant} starts from the agent of {variant.base}, which is not there: "
            f"`imujoco train {variant.base}` first, or train with --scratch"
        )
    return Start(str(variant.base), str(record["weights_sha256"]), load_arrays(path))


def best_start(variant: Variant, policies: Path | None = None) -> Start:
    """Return what does better on ``variant``: the agent of its base, or the robot's generalist, if there.

    Raises:
        PolicyNotFoundError: when the base's agent is not there.
    """
    base, path = base_start(variant, policies), agent_file(generalist_name(variant.robot), policies)
    if path is None:
        return base
    record = generalist_record(variant.robot, policies)
    generalist = Start(generalist_name(variant.robot), str(record["weights_sha256"]), load_arrays(path))
    env = make(variant, disable_env_checker=True)
    try:
        return max(base, generalist, key=lambda start: _score(env, variant, start))
    finally:
        env.close()


def _score(env: Env[Any, Any], variant: Variant, start: Start) -> float:
    settings = hyperparameters(variant.robot, WARM)
    actor = actor_of(agent_actor(start.agent), settings.algorithm)
    score = evaluate(env, actor, episodes=settings.ranking_episodes, seed=START_SEED)
    return score.return_mean - score.return_std
