"""Rungs: actors saved while an expert was trained. A variant's record lists them as its ladder.

An entry of a ladder states the ``steps`` of training after which the rung was saved and its ``evaluation``
on the variant. ``run`` names the variant whose training saved it; without ``run`` it is the base robot's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from imujoco_minari.errors import PolicyNotFoundError
from imujoco_minari.policies.actors import Actor
from imujoco_minari.policies.experts import expert_record, find_policy_file, policy_files
from imujoco_minari.policies.files import read_actor
from imujoco_minari.variants import Variant

Rung = Mapping[str, Any]

# Medium is the rung whose return is nearest to this share of the expert's. It should be within the range.
# The training run of medium-replay ends at the first actor that reaches the share.
MEDIUM_SHARE = 0.42
MEDIUM_RANGE = (1 / 3, 1 / 2)
# Shares that the rungs of ranked data should have, below the expert, and how far they may be off.
RANKED_SHARES = (0.8, 0.6, 0.4, 0.2)
RANKED_TOLERANCE = 0.1
# The episodes that measure a rung.
LADDER_EPISODES, LADDER_SEED = 10, 1_000_004


def rungs_of_robot(base: Variant) -> list[dict[str, Any]]:
    """Return the ``steps`` of all rungs of a robot, and the ``run`` of those that no base's run saved."""
    rungs: list[dict[str, Any]] = []
    for name in policy_files(f"{base.robot}-*.rung-*.safetensors"):
        run, _, steps = name.removesuffix(".safetensors").partition(".rung-")
        if steps.isdecimal():
            rungs.append(({} if run == str(base) else {"run": run}) | {"steps": int(steps)})
    return sorted(rungs, key=lambda rung: (rung.get("run", ""), rung["steps"]))


def medium_rung(rungs: Sequence[Rung], expert: Mapping[str, Any]) -> Rung:
    """Return the rung whose return is nearest to 0.42 of that of the expert with this record."""
    wanted = return_at(MEDIUM_SHARE, expert)
    return min(rungs, key=lambda rung: abs(mean_return(rung) - wanted))


def ranked_rungs(rungs: Sequence[Rung], expert: Mapping[str, Any]) -> list[Rung]:
    """Return the rungs below the expert that are nearest to :data:`RANKED_SHARES`, the best first.

    There are fewer of them if fewer rungs are below the expert.
    """
    below = [rung for rung in rungs if mean_return(rung) < mean_return(expert)]
    chosen: list[Rung] = []
    for share in RANKED_SHARES[: len(below)]:
        wanted = return_at(share, expert)
        chosen.append(min((r for r in below if r not in chosen), key=lambda r: abs(mean_return(r) - wanted)))
    return sorted(chosen, key=mean_return, reverse=True)


def has_medium(record: Mapping[str, Any]) -> bool:
    """Return whether the medium rung of a training record has a third to a half of the expert's return."""
    rungs = record.get("ladder", ())
    low, high = MEDIUM_RANGE
    return bool(rungs) and low <= share_of(mean_return(medium_rung(rungs, record)), record) <= high


def has_even_ranks(record: Mapping[str, Any]) -> bool:
    """Return whether the ranked rungs of a training record have about the returns that they should have."""
    chosen = ranked_rungs(record.get("ladder", ()), record)
    return len(chosen) == len(RANKED_SHARES) and all(
        abs(share_of(mean_return(rung), record) - share) <= RANKED_TOLERANCE
        for rung, share in zip(chosen, RANKED_SHARES, strict=True)
    )


def rung_file(run: Variant | str, steps: int) -> str:
    """Return the file name of the rung that the training of a variant or base saved after ``steps`` steps."""
    return f"{run}.rung-{steps}.safetensors"


def read_rung(variant: Variant, rung: Rung, *, deterministic: bool = True) -> Actor:
    """Return the actor of a rung in the ladder of ``variant``.

    Raises:
        PolicyNotFoundError: if the file of the rung is missing.
    """
    name = rung_file(rung.get("run", variant.base), rung["steps"])
    path = find_policy_file(name)
    if path is None:
        raise PolicyNotFoundError(f"the training record of {variant} names {name}, which is missing")
    algorithm = expert_record(variant)["algorithm"]
    return read_actor(path, deterministic=deterministic, algorithm=algorithm).for_robot(variant.robot)


def share_of(value: float, expert: Mapping[str, Any]) -> float:
    """Return the share that a return has of the expert's with this record.

    If the expert's return is negative, as a reacher's is, the share is counted from the random policy's.
    """
    low = _zero(expert)
    return (value - low) / (mean_return(expert) - low)


def return_at(share: float, expert: Mapping[str, Any]) -> float:
    """Return the return whose :func:`share_of` is ``share``."""
    low = _zero(expert)
    return low + share * (mean_return(expert) - low)


def _zero(expert: Mapping[str, Any]) -> float:
    return 0.0 if mean_return(expert) > 0 else float(expert["random"]["return_mean"])


def mean_return(measured: Mapping[str, Any]) -> float:
    """Return the mean return in the evaluation of a rung or of a training record."""
    return float(measured["evaluation"]["return_mean"])
