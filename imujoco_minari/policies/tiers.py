"""Tiers: the policies that make a dataset, and the number of episodes of each.

Besides the expert and the random policy, tiers use the ladder: actors that were saved during the base robot's
training and evaluated on the variant. ``medium`` is one rung. ``medium-expert`` is that rung and the expert,
half each. ``ranked`` is equal shares of the expert and several rungs. Its episodes have rank and return as
attributes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from imujoco_minari.errors import DatasetError, PolicyNotFoundError, suggestion
from imujoco_minari.policies import Actor, Policy, expert_record, find_policy_file, load_policy, read_actor
from imujoco_minari.variants import EXPERT, Variant

RANDOM, MEDIUM, MEDIUM_EXPERT, RANKED, REPLAY = "random", "medium", "medium-expert", "ranked", "replay"
TIERS = (EXPERT, MEDIUM, RANDOM, MEDIUM_EXPERT, RANKED, REPLAY)
# Medium is the rung nearest to this share of the expert's return, between a third and a half.
MEDIUM_SHARE = 0.42
# Number of policies of ranked data, including the expert.
RANKS = 5


@dataclass(frozen=True)
class Part:
    """The episodes of a dataset that one policy makes.

    Attributes:
        policy: the policy.
        episodes: number of episodes.
        attributes: attributes of these episodes, in addition to the dataset's.
    """

    policy: Policy
    episodes: int
    attributes: Mapping[str, Any] = field(default_factory=dict)


def parts(variant: Variant, tier: str, episodes: int, *, path: Path | None, stochastic: bool) -> list[Part]:
    """Return the parts of a dataset of ``tier``, in the order of its episodes.

    Args:
        variant: the variant.
        tier: one of :data:`TIERS`, or any name if ``path`` is given.
        episodes: number of episodes of the complete dataset.
        path: a policy file that makes all episodes.
        stochastic: sample the actors' actions instead of taking their mode.

    Raises:
        PolicyNotFoundError: if the tier is unknown, or the variant has no policy for it.
        DatasetError: if the number of episodes is not a multiple of the number of parts.
    """
    if path is not None or tier in (EXPERT, RANDOM):
        return [Part(load_policy(variant, tier=tier, path=path, stochastic=stochastic), episodes)]
    if tier == REPLAY:
        raise PolicyNotFoundError(
            f"the tier {REPLAY} is recorded while a policy is trained: run "
            f"`imujoco train {variant} --record-replay`"
        )
    if tier not in TIERS:
        raise PolicyNotFoundError(
            f"unknown tier {tier!r}{suggestion(tier, TIERS)}; "
            f"valid: {', '.join(TIERS)}, or any name with --policy FILE"
        )
    makers: dict[str, Callable[[Variant, bool], list[tuple[Policy, dict[str, Any]]]]] = {
        MEDIUM: _medium_policies,
        MEDIUM_EXPERT: _medium_expert_policies,
        RANKED: _ranked_policies,
    }
    made = makers[tier](variant, not stochastic)
    if episodes % len(made):
        raise DatasetError(
            f"the tier {tier} has {len(made)} equal parts: "
            f"{episodes} episodes are not a multiple of {len(made)}"
        )
    return [Part(policy, episodes // len(made), attributes) for policy, attributes in made]


def ladder(variant: Variant) -> Sequence[Mapping[str, Any]]:
    """Return the rungs of the variant's record, in ascending order of their return on the variant.

    Raises:
        PolicyNotFoundError: if the variant has no record, or its record has no ladder.
    """
    rungs = expert_record(variant).get("ladder")
    if not rungs:
        raise PolicyNotFoundError(
            f"no ladder of policies for {variant}: run `imujoco train {variant}`, which measures one"
        )
    return sorted(rungs, key=_mean_return)


def medium_rung(rungs: Sequence[Mapping[str, Any]], expert_return: float) -> Mapping[str, Any]:
    """Return the rung whose return is nearest to 0.42 of the expert's."""
    return min(rungs, key=lambda rung: abs(_mean_return(rung) - MEDIUM_SHARE * expert_return))


def rung_file(variant: Variant, steps: int) -> str:
    """Return the file name of the rung that was saved after ``steps`` steps of the base's training."""
    return f"{variant.base}.rung-{steps}.safetensors"


def _medium_policies(variant: Variant, deterministic: bool) -> list[tuple[Policy, dict[str, Any]]]:
    record = expert_record(variant)
    rung = medium_rung(ladder(variant), record["evaluation"]["return_mean"])
    return [(_read_rung(variant, rung, deterministic), {"rung": int(rung["steps"])})]


def _medium_expert_policies(variant: Variant, deterministic: bool) -> list[tuple[Policy, dict[str, Any]]]:
    expert = load_policy(variant, stochastic=not deterministic)
    (medium, attributes), *_ = _medium_policies(variant, deterministic)
    return [(medium, attributes | {"part": MEDIUM}), (expert, {"part": EXPERT})]


def _ranked_policies(variant: Variant, deterministic: bool) -> list[tuple[Policy, dict[str, Any]]]:
    """Return the expert and the rungs whose returns are spaced most evenly below it, best first."""
    expert_return = expert_record(variant)["evaluation"]["return_mean"] if expert_record(variant) else 0.0
    rungs = [rung for rung in ladder(variant) if _mean_return(rung) < expert_return]
    if len(rungs) < RANKS - 1:
        raise PolicyNotFoundError(
            f"{variant} has {len(rungs)} rungs below its expert; the tier {RANKED} needs {RANKS - 1}"
        )
    chosen: list[Mapping[str, Any]] = []
    for rank in range(1, RANKS):
        wanted = expert_return * (1 - rank / RANKS)
        chosen.append(min((r for r in rungs if r not in chosen), key=lambda r: abs(_mean_return(r) - wanted)))
    chosen.sort(key=_mean_return, reverse=True)
    ranked: list[tuple[Policy, dict[str, Any]]] = [
        (load_policy(variant, stochastic=not deterministic), {"rank": 0, "policy_return": expert_return})
    ]
    for rank, rung in enumerate(chosen, start=1):
        attributes = {"rank": rank, "policy_return": _mean_return(rung), "rung": int(rung["steps"])}
        ranked.append((_read_rung(variant, rung, deterministic), attributes))
    return ranked


def _read_rung(variant: Variant, rung: Mapping[str, Any], deterministic: bool) -> Actor:
    name = rung_file(variant, rung["steps"])
    path = find_policy_file(name)
    if path is None:
        raise PolicyNotFoundError(f"the record of {variant} names {name}, which does not exist")
    algorithm = expert_record(variant)["algorithm"]
    return read_actor(path, deterministic=deterministic, algorithm=algorithm)


def _mean_return(rung: Mapping[str, Any]) -> float:
    return float(rung["evaluation"]["return_mean"])
