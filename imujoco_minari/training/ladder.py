"""The ladder: rungs of a base run's checkpoints, and what each of them scores on a variant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from imujoco_minari.envs.registration import make
from imujoco_minari.policies import expert_record, find_policy_file, read_actor
from imujoco_minari.policies.rollouts import evaluate
from imujoco_minari.policies.tiers import medium_rung, rung_file
from imujoco_minari.training.agents import load_arrays, save_arrays
from imujoco_minari.variants import Variant

# Returns, as shares of the base expert's, near which rungs are kept.
SHARES = (0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.7, 0.85)
EPISODES = 10
LADDER_SEED = 1_000_004


def keep_rungs(
    folder: Path, evaluations: Sequence[Mapping[str, Any]], expert: float, base: Variant, target: Path
) -> list[int]:
    """Copy the checkpoints nearest to each share of the expert's return to ``target``; return their steps.

    Args:
        folder: the ladder of the base's run, one actor a checkpoint, named by its steps.
        evaluations: the run's, with ``steps`` and ``return_mean``.
        expert: the base expert's return.
        base: the base robot.
        target: the folder of finished policies.
    """
    there = [entry for entry in evaluations if (folder / f"{entry['steps']}.safetensors").is_file()]
    kept = {
        min(there, key=lambda entry: abs(entry["return_mean"] - share * expert))["steps"] for share in SHARES
    }
    for steps in kept:
        save_arrays(target / rung_file(base, steps), load_arrays(folder / f"{steps}.safetensors"))
    return sorted(kept)


def measure_ladder(
    variant: Variant, expert: float, steps: Sequence[int], policies: Path | None
) -> list[dict[str, Any]]:
    """Evaluate the rungs of the base's ladder on ``variant``; the medium one by as many episodes as experts.

    Args:
        variant: what to evaluate on.
        expert: its expert's return.
        steps: the rungs.
        policies: where policies lie; None for the user's folder.
    """
    env = make(variant, disable_env_checker=True)
    try:
        rungs = [
            {"steps": rung, "evaluation": _score(env, variant, rung, EPISODES, policies)} for rung in steps
        ]
        if rungs:
            medium = medium_rung(rungs, expert)
            medium["evaluation"] = _score(env, variant, medium["steps"], 100, policies)  # type: ignore[index]
    finally:
        env.close()
    return rungs


def rungs_of(base: Variant, policies: Path | None) -> list[int]:
    """Return the steps of the rungs that the base's record lists."""
    return [int(rung["steps"]) for rung in expert_record(base, policies).get("ladder", [])]


def _score(env: Any, variant: Variant, steps: int, episodes: int, policies: Path | None) -> dict[str, Any]:
    path = find_policy_file(rung_file(variant, steps), policies)
    if path is None:
        raise FileNotFoundError(rung_file(variant, steps))
    return evaluate(env, read_actor(path), episodes=episodes, seed=LADDER_SEED).asdict()
