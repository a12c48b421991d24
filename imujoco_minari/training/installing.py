"""A finished run becomes the policy of its variant: weights, ladder and record in the policies folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from imujoco_minari.errors import PolicyNotFoundError
from imujoco_minari.policies import find_policy_file, read_actor
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.rungs import mean_return
from imujoco_minari.storage.files import write_json
from imujoco_minari.training.agents import load_arrays, save_arrays
from imujoco_minari.training.ladder import Ladder
from imujoco_minari.training.plan import Plan
from imujoco_minari.training.run import OnInterval, load_progress, score
from imujoco_minari.training.task import Task
from imujoco_minari.variants import BASE, Variant

# The entries of a record that are kept, under `before`, when the policy is improved.
_HISTORY_KEYS = (
    "start",
    "seed",
    "steps",
    "steps_trained",
    "updates",
    "wall_seconds",
    "weights_sha256",
    "evaluation",
    "before",
)


def with_history(record: dict[str, Any], before: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record of an improved policy. Its entry ``before`` keeps part of the earlier record."""
    return record | ({"before": {key: before.get(key) for key in _HISTORY_KEYS}} if before else {})


def is_better(record: Mapping[str, Any], task: Task, policies: Path) -> bool:
    """Return whether a run's best actor beats the present expert, on the episodes that select actors.

    The episodes of the records' evaluations select nothing.

    Args:
        record: the record of the run.
        task: the run.
        policies: the folder of finished policies.
    """
    present, selection = find_policy_file(f"{task.variant}.safetensors", policies), record["selection"]
    if present is None:
        return True
    actor, episodes = read_actor(present).for_robot(task.variant.robot), selection["episodes"]
    other = evaluate(task.variant, actor, episodes=episodes, seed=selection["seed"])
    return score(selection) > score(other.asdict())


def install(
    variant: Variant, folder: Path, record: dict[str, Any], plan: Plan, on_interval: OnInterval
) -> dict[str, Any]:
    """Copy the policy of a finished run to the policies folder and return its complete record.

    For a base, its complete agent and the rungs of its ladder are copied too.

    Args:
        variant: the variant.
        folder: state folder of the run.
        record: the run's record.
        plan: the settings.
        on_interval: called after every interval of a climb.
    """
    evaluations, checkpoints = load_progress(folder).evaluations, folder / "ladder"
    ladder = Ladder(variant, mean_return(record), plan.policies)
    ladder.add_known()
    if variant.category == BASE:
        # An improved base keeps its first ladder: the returns of further training do not rise step by step.
        if not ladder.rungs:
            ladder.add_spread(checkpoints, evaluations)
        agent = load_arrays(folder / "best-agent.safetensors")
        save_arrays(plan.policies / f"{variant}.agent.safetensors", agent)
    ladder.add_missing(checkpoints, evaluations)
    ladder.climb(plan, folder / "climb", on_interval)
    return _write_policy(ladder, folder / "best.safetensors", record)


def renew_ladder(
    variant: Variant, folder: Path, record: dict[str, Any], plan: Plan, on_interval: OnInterval
) -> dict[str, Any]:
    """Measure the ladder of a finished policy again, add rungs that it lacks, and return its record.

    Args:
        variant: the variant.
        folder: state folder of the climb.
        record: the policy's record.
        plan: the settings.
        on_interval: called after every interval of the climb.

    Raises:
        PolicyNotFoundError: if the policy's file or the file of a rung is missing.
    """
    weights = find_policy_file(f"{variant}.safetensors", plan.policies)
    if weights is None:
        raise PolicyNotFoundError(f"{variant} has a training record, but {variant}.safetensors is missing")
    ladder = Ladder(variant, mean_return(record), plan.policies)
    ladder.add_known()
    ladder.climb(plan, folder / "climb", on_interval)
    return _write_policy(ladder, weights, record)


def _write_policy(ladder: Ladder, weights: Path, record: dict[str, Any]) -> dict[str, Any]:
    record = record | {"ladder": ladder.rungs}
    save_arrays(ladder.policies / f"{ladder.variant}.safetensors", load_arrays(weights))
    # The record is written last. Its presence means that the policy is complete.
    write_json(ladder.policies / f"{ladder.variant}.json", record)
    return record
