"""The agent that a variant's training starts from: the base's, or the generalist if it scores higher.

A generalist is one agent trained over all variants of a robot. It cannot know its present variant, so it is
no expert, but it falls less often than the base's agent in a strongly changed variant.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from imujoco_minari.errors import PolicyNotFoundError
from imujoco_minari.policies import Array, agent_file, expert_record
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.training.agents import actor_of, agent_actor, load_arrays
from imujoco_minari.training.run import score
from imujoco_minari.variants import Variant

EPISODES, START_SEED = 5, 1_000_005


@dataclass
class Start:
    """An agent to start from.

    Attributes:
        name: name of the agent.
        sha256: digest of its actor, from its record.
        agent: arrays of the agent.
        score: score of its evaluation on the variant; -inf if not evaluated.
    """

    name: str
    sha256: str
    agent: dict[str, Array] = field(repr=False)
    score: float = float("-inf")


def generalist_name(robot: str) -> str:
    """Return the name of a robot's generalist, ``<robot>-all``."""
    return f"{robot}-all"


def generalist_record(robot: str, policies: Path) -> dict[str, Any]:
    """Return the training record of a robot's generalist; empty if it does not exist."""
    path = agent_file(generalist_name(robot), policies)
    return {} if path is None else json.loads(path.with_suffix(".json").read_text("utf-8"))


def base_start(variant: Variant, policies: Path) -> Start:
    """Return the agent of a variant's base.

    Raises:
        PolicyNotFoundError: if that agent does not exist.
    """
    record, path = expert_record(variant.base, policies), agent_file(variant.base, policies)
    if not record or path is None:
        raise PolicyNotFoundError(
            f"{variant} starts from the agent of {variant.base}, which does not exist: run "
            f"`imujoco train {variant.base}` first, or train with --scratch"
        )
    return Start(str(variant.base), str(record["weights_sha256"]), load_arrays(path))


def best_start(variant: Variant, policies: Path) -> Start:
    """Return the better start for a variant: its base's agent, or the robot's generalist if it exists.

    Raises:
        PolicyNotFoundError: if the base's agent does not exist.
    """
    starts, path = [base_start(variant, policies)], agent_file(generalist_name(variant.robot), policies)
    if path is not None:
        record = generalist_record(variant.robot, policies)
        starts.append(Start(generalist_name(variant.robot), str(record["weights_sha256"]), load_arrays(path)))
    for start in starts:
        actor = actor_of(agent_actor(start.agent), variant.robot)
        start.score = score(evaluate(variant, actor, episodes=EPISODES, seed=START_SEED).asdict())
    return max(starts, key=lambda start: start.score)
