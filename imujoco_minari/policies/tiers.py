"""Tiers: which policies make a dataset, and how many of its episodes each.

Beside the expert and the random policy there is the ladder: actors saved on the way of the base robot's
training, each evaluated on the variant. ``medium`` is one rung, ``medium-expert`` half that and half
expert, ``ranked`` equal sets of several rungs with their rank and return as episode attributes.
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
# Medium is the rung nearest to this share of the expert's return: between a third and a half.
MEDIUM_SHARE = 0.42
# Ranked data comes from this many policies, the expert among them.
RANKS = 5


@dataclass(frozen=True)
class Part:
    """Some episodes of a dataset, that one policy makes.

    Attributes:
        policy: what acts.
        episodes: how many episodes.
        attributes: what these episodes carry beside the dataset's attributes.
    """

    policy: Policy
    episodes: int
    attributes: Mapping[str, Any] = field(default_factory=dict)


def parts(variant: Variant, tier: str, episodes: int, *, path: Path | None, stochastic: bool) -> list[Part]:
    """Return the parts of a dataset of ``tier``, in the order of its episodes.

    Args:
        variant: whose data.
        tier: one of :data:`TIERS`, or any name when ``path`` is given.
        episodes: of the whole dataset.
        path: a policy file that makes all of it.
        stochastic: sample the actors' actions instead of taking their mode.

    Raises:
        PolicyNotFoundError: when no policy makes the tier, or the variant has none.
        DatasetError: when the episodes cannot be divided among the parts.
    """
    if path is not None or tier in (EXPERT, RANDOM):
        return [Part(load_policy(variant, tier=tier, path=path, stochastic=stochastic), episodes)]
    if tier == REPLAY:
        raise PolicyNotFoundError(
            f"the tier {REPLAY} is recorded while a policy is trained: "
            f"`imujoco train {variant} --record-replay`"
        )
    if tier not in TIERS:
        raise PolicyNotFoundError(
            f"no policy makes the tier {tier!r}{suggestion(tier, TIERS)}; "
            f"valid: {', '.join(TIERS)}, or any name with --policy FILE"
        )
    makers: dict[str, Callable[[Variant, bool], list[tuple[Policy, dict[str, Any]]]]] = {
        MEDIUM: _medium,
        MEDIUM_EXPERT: _medium_expert,
        RANKED: _ranked,
    }
    made = makers[tier](variant, not stochastic)
    if episodes % len(made):
        raise DatasetError(f"the tier {tier} is of {len(made)} equal parts, and {episodes} episodes are not")
    return [Part(policy, episodes // len(made), attributes) for policy, attributes in made]


def ladder(variant: Variant) -> Sequence[Mapping[str, Any]]:
    """Return the rungs of the variant's record, lowest return on it first.

    Raises:
        PolicyNotFoundError: when the variant has no record, or its record no ladder.
    """
    rungs = expert_record(variant).get("ladder")
    if not rungs:
        raise PolicyNotFoundError(
            f"there is no ladder of policies for {variant}: `imujoco train {variant}` measures one"
        )
    return sorted(rungs, key=_return)


def medium_rung(rungs: Sequence[Mapping[str, Any]], expert_return: float) -> Mapping[str, Any]:
    """Return the rung whose return is nearest to 0.42 of the expert's."""
    return min(rungs, key=lambda rung: abs(_return(rung) - MEDIUM_SHARE * expert_return))


def rung_file(variant: Variant, steps: int) -> str:
    """Return the name of the file that holds the rung of a base's ladder, saved after ``steps``."""
    return f"{variant.base}.rung-{steps}.safetensors"


def _medium(variant: Variant, deterministic: bool) -> list[tuple[Policy, dict[str, Any]]]:
    record = expert_record(variant)
    rung = medium_rung(ladder(variant), record["evaluation"]["return_mean"])
    return [(_rung(variant, rung, deterministic), {"rung": int(rung["steps"])})]


def _medium_expert(variant: Variant, deterministic: bool) -> list[tuple[Policy, dict[str, Any]]]:
    expert = load_policy(variant, stochastic=not deterministic)
    (medium, attributes), *_ = _medium(variant, deterministic)
    return [(medium, attributes | {"part": MEDIUM}), (expert, {"part": EXPERT})]


def _ranked(variant: Variant, deterministic: bool) -> list[tuple[Policy, dict[str, Any]]]:
    """Return the expert and the rungs whose returns are spread most evenly below it, best first."""
    expert_return = expert_record(variant)["evaluation"]["return_mean"] if expert_record(variant) else 0.0
    rungs = [rung for rung in ladder(variant) if _return(rung) < expert_return]
    if len(rungs) < RANKS - 1:
        raise PolicyNotFoundError(
            f"{variant} has {len(rungs)} rungs below its expert; ranked data needs {RANKS - 1}"
        )
    chosen: list[Mapping[str, Any]] = []
    for rank in range(1, RANKS):
        wanted = expert_return * (1 - rank / RANKS)
        chosen.append(min((r for r in rungs if r not in chosen), key=lambda r: abs(_return(r) - wanted)))
    chosen.sort(key=_return, reverse=True)
    ranked: list[tuple[Policy, dict[str, Any]]] = [
        (load_policy(variant, stochastic=not deterministic), {"rank": 0, "policy_return": expert_return})
    ]
    for rank, rung in enumerate(chosen, start=1):
        attributes = {"rank": rank, "policy_return": _return(rung), "rung": int(rung["steps"])}
        ranked.append((_rung(variant, rung, deterministic), attributes))
    return ranked


def _rung(variant: Variant, rung: Mapping[str, Any], deterministic: bool) -> Actor:
    name = rung_file(variant, rung["steps"])
    path = find_policy_file(name)
    if path is None:
        raise PolicyNotFoundError(f"the record of {variant} names {name}, which is not there")
    algorithm = expert_record(variant)["algorithm"]
    return read_actor(path, deterministic=deterministic, algorithm=algorithm)


def _return(rung: Mapping[str, Any]) -> float:
    return float(rung["evaluation"]["return_mean"])
