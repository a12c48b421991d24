"""A finished run becomes the policy of its variant, if no policy that exists is as good."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from imujoco_minari.policies import Actor, find_policy_file, own_record, read_actor, universal_policy
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.rungs import LADDER_SEED, return_at, rung_file
from imujoco_minari.storage.files import write_json
from imujoco_minari.training.agents import actor_of, agent_actor, load_arrays, save_arrays
from imujoco_minari.training.run import Run
from imujoco_minari.training.selection import CHOOSING_SEED, score
from imujoco_minari.variants import BASE, Variant

# Shares of the base expert's return. The checkpoint nearest to each becomes a rung of the base.
RUNG_SHARES = (0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.7, 0.85)
RUNG_EPISODES = 100
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


def present_scores(variant: Variant, policies: Path, episodes: int) -> tuple[float, float]:
    """Return the scores of a variant's own and of its folded expert on the episodes that select actors.

    The score of one that does not exist is -inf. A base needs an expert of its own, so it has no folded one.
    """
    path = find_policy_file(f"{variant}.safetensors", policies)
    universal = None if variant.category == BASE else universal_policy(variant.robot, policies)
    own = read_actor(path).for_robot(variant.robot) if path and own_record(variant, policies) else None

    def score_of(actor: Actor | None) -> float:
        if actor is None:
            return float("-inf")
        return score(evaluate(variant, actor, episodes=episodes, seed=CHOOSING_SEED).asdict())

    return score_of(own), score_of(universal.fold(variant) if universal else None)


def install(run: Run, record: dict[str, Any], policies: Path) -> dict[str, Any]:
    """Copy the policy of a finished run to the policies folder and return its complete record.

    A base gets its agent and its ladder too. An improved base keeps its first ladder, because the returns of
    further training do not rise step by step.
    """
    variant, agent = run.task.variant, run.best_agent()
    before = own_record(variant, policies)
    if before:
        record = record | {"before": {key: before.get(key) for key in _HISTORY_KEYS}}
    if variant.category == BASE:
        save_arrays(policies / f"{variant}.agent.safetensors", agent)
        record = record | {"ladder": before.get("ladder") or _base_ladder(run, record, policies)}
    save_arrays(policies / f"{variant}.safetensors", agent_actor(agent))
    # The record is written last. Its presence means that the policy is complete.
    write_json(policies / f"{variant}.json", record)
    return record


def _base_ladder(run: Run, record: Mapping[str, Any], policies: Path) -> list[Mapping[str, Any]]:
    """Save the checkpoint nearest to each of the shares as a rung, and return the ladder."""
    base, evaluations = run.task.variant, run.progress.evaluations

    def nearest(share: float) -> int:
        wanted = return_at(share, record)
        return int(min(evaluations, key=lambda e: abs(e["present"]["return_mean"] - wanted))["steps"])

    ladder: list[Mapping[str, Any]] = []
    for steps in sorted({nearest(share) for share in RUNG_SHARES}):
        arrays = load_arrays(run.folder / "ladder" / f"{steps}.safetensors")
        save_arrays(policies / rung_file(base, steps), arrays)
        actor = actor_of(arrays, base.robot)
        measured = evaluate(base, actor, episodes=RUNG_EPISODES, seed=LADDER_SEED).asdict()
        ladder.append({"steps": steps, "evaluation": measured})
    return ladder
