"""The ladder: checkpoints of a base's training that are kept as rungs, and their scores on a variant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from imujoco_minari.policies import expert_record, find_policy_file, read_actor
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.tiers import medium_rung, rung_file
from imujoco_minari.training.agents import load_arrays, save_arrays
from imujoco_minari.variants import Variant

# Shares of the base expert's return. The checkpoint nearest to each is kept as a rung.
SHARES = (0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.7, 0.85)
EPISODES = 10
LADDER_SEED = 1_000_004


def keep_rungs(
    folder: Path, evaluations: Sequence[Mapping[str, Any]], expert: float, base: Variant, target: Path
) -> list[int]:
    """Copy the checkpoint nearest to each of :data:`SHARES` to ``target`` and return their steps.

    Args:
        folder: the run's checkpoints, one actor per file, named by its steps.
        evaluations: the run's evaluations, each with ``steps`` and ``return_mean``.
        expert: the base expert's return.
        base: the base robot.
        target: the folder of finished policies.
    """
    available = [entry for entry in evaluations if (folder / f"{entry['steps']}.safetensors").is_file()]
    kept = {
        min(available, key=lambda entry: abs(entry["return_mean"] - share * expert))["steps"]
        for share in SHARES
    }
    for steps in kept:
        save_arrays(target / rung_file(base, steps), load_arrays(folder / f"{steps}.safetensors"))
    return sorted(kept)


def measure_ladder(
    variant: Variant, expert: float, steps: Sequence[int], policies: Path | None
) -> list[dict[str, Any]]:
    """Evaluate the rungs of the base's ladder on a variant, the medium rung with 100 episodes.

    Args:
        variant: the variant to evaluate on.
        expert: the return of the variant's expert.
        steps: the training steps of each rung.
        policies: the folder of policies; None for the user's folder.

    Returns:
        For each rung a dictionary of ``steps`` and ``evaluation``.

    Raises:
        FileNotFoundError: if the file of a rung is missing.
    """
    rungs = [
        {"steps": rung, "evaluation": _evaluate_rung(variant, rung, EPISODES, policies)} for rung in steps
    ]
    if rungs:
        medium = medium_rung(rungs, expert)
        medium["evaluation"] = _evaluate_rung(variant, medium["steps"], 100, policies)  # type: ignore[index]
    return rungs


def rungs_of(base: Variant, policies: Path | None) -> list[int]:
    """Return the training steps of the rungs that the base's record lists."""
    return [int(rung["steps"]) for rung in expert_record(base, policies).get("ladder", [])]


def _evaluate_rung(variant: Variant, steps: int, episodes: int, policies: Path | None) -> dict[str, Any]:
    path = find_policy_file(rung_file(variant, steps), policies)
    if path is None:
        raise FileNotFoundError(rung_file(variant, steps))
    actor = read_actor(path).for_robot(variant.robot)
    return evaluate(variant, actor, episodes=episodes, seed=LADDER_SEED).asdict()
