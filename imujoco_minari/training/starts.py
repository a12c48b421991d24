"""What a variant's training starts from: the base's agent, or the generalist's where that does better on it.

A generalist is one agent trained over all variants of a robot. It is nobody's expert, as it cannot know
in which variant it walks; but on a far variant it falls less than the base's does.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gymnasium import Env

from imujoco_minari.envs.registration import make
from imujoco_minari.errors import PolicyNotFoundError
from imujoco_minari.policies import Array, agent_file, expert_record
from imujoco_minari.policies.rollouts import evaluate
from imujoco_minari.training.agents import actor_of, agent_actor, load_arrays
from imujoco_minari.training.hyperparameters import WARM, hyperparameters
from imujoco_minari.variants import Variant

START_SEED = 1_000_005


@dataclass(frozen=True)
class Start:
    """An agent to start from.

    Attributes:
        name: of the agent.
        sha256: digest of its actor, as its record has it.
        agent: its arrays.
        score: mean less deviation of its return on the variant, where that was asked.
    """

    name: str
    sha256: str
    agent: dict[str, Array] = field(repr=False)
    score: float = float("-inf")


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
    starts, path = [base_start(variant, policies)], agent_file(generalist_name(variant.robot), policies)
    if path is not None:
        record = generalist_record(variant.robot, policies)
        starts.append(Start(generalist_name(variant.robot), str(record["weights_sha256"]), load_arrays(path)))
    env = make(variant, disable_env_checker=True)
    try:
        return max((_scored(env, variant.robot, start) for start in starts), key=lambda start: start.score)
    finally:
        env.close()


def _scored(env: Env[Any, Any], robot: str, start: Start) -> Start:
    settings = hyperparameters(robot, WARM)
    actor = actor_of(agent_actor(start.agent), settings.algorithm)
    return replace(
        start, score=evaluate(env, actor, episodes=settings.ranking_episodes, seed=START_SEED).score
    )
