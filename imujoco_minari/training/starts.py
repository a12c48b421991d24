"""The agent that a variant's training starts from: the base's, or the generalist if it scores higher.

A generalist is one agent trained over all variants of a robot. It cannot know its present variant, so it is
no expert, but it falls less often than the base's agent in a strongly changed variant.

If neither reaches the target, the experts of other variants are tried. An expert is an actor without critics.
So it takes the place of the agent's actor only if it reaches the target, or is far better.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from imujoco_minari.errors import PolicyNotFoundError
from imujoco_minari.policies import Array, agent_file, expert_variants, find_policy_file, own_record
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.rungs import mean_return
from imujoco_minari.training.agents import actor_of, agent_actor, load_arrays, replace_actor
from imujoco_minari.training.run import score as score_of
from imujoco_minari.variants import Variant

EPISODES, START_SEED = 5, 1_000_005
# How much better than the agent's actor an expert must be, as a share of the agent's score.
FAR_BETTER = 0.25


@dataclass
class Start:
    """An agent to start from.

    Attributes:
        name: name of the agent, or the variant whose expert is its actor.
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
    record, path = own_record(variant.base, policies), agent_file(variant.base, policies)
    if not record or path is None:
        raise PolicyNotFoundError(
            f"{variant} starts from the agent of {variant.base}, which does not exist: run "
            f"`imujoco train {variant.base}` first, or train with --scratch"
        )
    return Start(str(variant.base), str(record["weights_sha256"]), load_arrays(path))


def best_start(variant: Variant, policies: Path, target_share: float = 0.0) -> Start:
    """Return the best start for a variant.

    Args:
        variant: the variant.
        policies: folder to search before the package's.
        target_share: the score that an expert should have, as a share of the base expert's mean return. If no
            agent has it, the experts of other variants are tried.

    Raises:
        PolicyNotFoundError: if the base's agent does not exist.
    """
    starts, path = [base_start(variant, policies)], agent_file(generalist_name(variant.robot), policies)
    if path is not None:
        record = generalist_record(variant.robot, policies)
        starts.append(Start(generalist_name(variant.robot), str(record["weights_sha256"]), load_arrays(path)))
    for start in starts:
        start.score = _score(variant, agent_actor(start.agent), EPISODES)
    best = max(starts, key=lambda start: start.score)
    target = target_share * mean_return(own_record(variant.base, policies))
    return best if best.score >= target else _expert_start(variant, best, target, policies)


def _expert_start(variant: Variant, best: Start, target: float, policies: Path) -> Start:
    """Return a start with the expert of another variant, or ``best`` if no expert is good enough."""
    needed = min(target, best.score + FAR_BETTER * abs(best.score))
    experts = _other_experts(variant, agent_actor(best.agent), policies)
    # A robot has dozens of experts, so each is seen in one episode first.
    first = {other: _score(variant, actor, 1) for other, actor in experts.items()}
    for other in sorted(first, key=first.__getitem__, reverse=True):
        if first[other] < needed:
            break
        score = _score(variant, experts[other], EPISODES)
        if score >= needed:
            sha256 = str(own_record(other, policies)["weights_sha256"])
            return Start(str(other), sha256, replace_actor(best.agent, experts[other]), score)
    return best


def _other_experts(
    variant: Variant, own: dict[str, Array], policies: Path
) -> dict[Variant, dict[str, Array]]:
    """Return the experts of the robot's other variants whose arrays have the shapes of the actor ``own``."""
    found = {}
    for other in expert_variants(policies):
        path = find_policy_file(f"{other}.safetensors", policies)
        if other.robot != variant.robot or other in (variant, variant.base) or path is None:
            continue
        actor = load_arrays(path)
        if _shapes(actor) == _shapes(own):
            found[other] = actor
    return found


def _shapes(arrays: dict[str, Array]) -> dict[str, tuple[int, ...]]:
    return {name: array.shape for name, array in arrays.items()}


def _score(variant: Variant, actor: dict[str, Array], episodes: int) -> float:
    measured = evaluate(variant, actor_of(actor, variant.robot), episodes=episodes, seed=START_SEED)
    return score_of(measured.asdict())
