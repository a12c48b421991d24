"""Tiers: the policies that make a dataset, and the number of episodes that each of them makes.

The ladder of a variant is a list of actors (rungs) that were saved while the expert of the base robot was
trained; each is evaluated on the variant. ``medium`` is one rung. ``medium-expert`` is that rung and the
expert, in equal parts. ``ranked`` is the expert and several rungs, in equal parts; each episode states its
policy's rank and return. ``expert-stochastic`` samples the expert's actions. ``replay`` and ``medium-replay``
are recorded while a policy is trained, so no policy of this module makes them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from imujoco_minari.errors import DatasetError, PolicyNotFoundError, suggestion
from imujoco_minari.policies.actors import Actor, Policy, random_policy
from imujoco_minari.policies.experts import expert_actor, expert_record, find_policy_file
from imujoco_minari.policies.files import read_actor
from imujoco_minari.storage.missing import making
from imujoco_minari.variants import EXPERT, Variant

EXPERT_STOCHASTIC, RANDOM, MEDIUM = "expert-stochastic", "random", "medium"
MEDIUM_EXPERT, RANKED, MEDIUM_REPLAY, REPLAY = "medium-expert", "ranked", "medium-replay", "replay"
TIERS = (EXPERT, EXPERT_STOCHASTIC, MEDIUM, RANDOM, MEDIUM_EXPERT, RANKED, MEDIUM_REPLAY, REPLAY)
# Tiers that are recorded while a policy is trained.
RECORDED = (MEDIUM_REPLAY, REPLAY)
# Medium is the rung whose return is nearest to this share of the expert's: between a third and a half.
# The training run of medium-replay ends at the first actor that reaches it.
MEDIUM_SHARE = 0.42
# Number of policies that make ranked data, the expert included.
RANKS = 5

# A policy, and the attributes of its episodes.
_Maker = tuple[Policy, dict[str, Any]]


@dataclass(frozen=True)
class TierPart:
    """The episodes of a dataset that one policy makes.

    Attributes:
        policy: the policy.
        episodes: number of episodes.
        attributes: episode attributes in addition to those of the dataset.
    """

    policy: Policy
    episodes: int
    attributes: Mapping[str, Any] = field(default_factory=dict)


def load_policy(
    variant: Variant | str, *, tier: str = EXPERT, path: str | Path | None = None, stochastic: bool = False
) -> Policy:
    """Return the policy that makes a variant's data of a tier.

    Args:
        variant: a variant or its id.
        tier: ``expert``, ``expert-stochastic``, ``medium`` or ``random``; ignored when ``path`` is given.
            Several policies make ``medium-expert`` and ``ranked``:
            :func:`~imujoco_minari.policies.tiers.parts` returns them.
        path: a Stable-Baselines3 ``.zip`` or an actor's ``.safetensors`` to use instead.
        stochastic: sample actions instead of taking their mode.

    Raises:
        VariantError: when ``variant`` names no variant.
        PolicyNotFoundError: when no single policy makes the tier, or ``path`` does not exist.
        PolicyError: when the file holds no actor, or the actor does not fit the robot.

    Examples:
        >>> load_policy("hopper-base")
        Actor(CrossQ, layers 11-256-256-3, ReLU, deterministic)
    """
    if not isinstance(variant, Variant):
        variant = Variant.parse(variant)
    makers = _makers(variant, tier, path, stochastic)
    if len(makers) > 1:
        raise PolicyNotFoundError(
            f"{len(makers)} policies make the tier {tier!r}: imujoco_minari.policies.tiers.parts() returns "
            f"them; valid here: {', '.join(_ONE_POLICY)}, or a path"
        )
    return makers[0][0]


def parts(
    variant: Variant, tier: str, episodes: int, *, path: Path | None, stochastic: bool
) -> list[TierPart]:
    """Return the parts of a dataset of a tier, in the order of its episodes.

    Args:
        variant: the variant of the dataset.
        tier: one of :data:`TIERS`, or any name when ``path`` is given.
        episodes: number of episodes of the whole dataset.
        path: file of a policy that makes all of the dataset.
        stochastic: sample the actors' actions instead of taking their mode.

    Raises:
        PolicyNotFoundError: when no policy makes the tier, or a policy of the variant is missing.
        PolicyError: when a file holds no actor, or the actor does not fit the robot.
        DatasetError: when the episodes cannot be divided equally among the policies.
    """
    makers = _makers(variant, tier, path, stochastic)
    if episodes % len(makers):
        raise DatasetError(
            f"{len(makers)} policies make equal parts of the tier {tier}: {episodes} episodes cannot be "
            f"divided by {len(makers)}"
        )
    return [TierPart(policy, episodes // len(makers), attributes) for policy, attributes in makers]


def ladder(variant: Variant) -> Sequence[Mapping[str, Any]]:
    """Return the rungs in the variant's training record, the lowest return first.

    Raises:
        PolicyNotFoundError: when the variant has no record, or its record has no ladder.
    """
    rungs = expert_record(variant).get("ladder")
    if not rungs:
        raise PolicyNotFoundError(
            f"no ladder of policies exists for {variant}: `imujoco train {variant}` measures one"
        )
    return sorted(rungs, key=_mean_return)


def medium_rung(rungs: Sequence[Mapping[str, Any]], expert_return: float) -> Mapping[str, Any]:
    """Return the rung whose return is nearest to 0.42 of the expert's."""
    return min(rungs, key=lambda rung: abs(_mean_return(rung) - MEDIUM_SHARE * expert_return))


def rung_file(variant: Variant, steps: int) -> str:
    """Return the file name of the rung that was saved after ``steps`` steps of training the base's expert."""
    return f"{variant.base}.rung-{steps}.safetensors"


def _makers(variant: Variant, tier: str, path: str | Path | None, stochastic: bool) -> list[_Maker]:
    """Return the policies that make a dataset; each makes the same number of episodes."""
    if path is not None:
        actor = read_actor(path, deterministic=not stochastic).for_robot(variant.robot)
        return [(actor, {})]
    if tier in RECORDED:
        raise PolicyNotFoundError(
            f"no single policy makes the tier {tier}: it is recorded while a policy is trained, "
            f"with `{making(variant.dataset_id(tier))}`"
        )
    if not isinstance(tier, str) or tier not in _MAKERS:
        near = suggestion(tier, TIERS) if isinstance(tier, str) else ""
        raise PolicyNotFoundError(
            f"no policy makes the tier {tier!r}{near}; "
            f"valid: {', '.join(TIERS)}, or any name with --policy FILE"
        )
    return _MAKERS[tier](variant, not stochastic)


def _expert(variant: Variant, deterministic: bool) -> list[_Maker]:
    return [(expert_actor(variant, deterministic=deterministic), {})]


def _expert_stochastic(variant: Variant, deterministic: bool) -> list[_Maker]:
    return _expert(variant, deterministic=False)


def _medium(variant: Variant, deterministic: bool) -> list[_Maker]:
    rungs = ladder(variant)
    rung = medium_rung(rungs, expert_record(variant)["evaluation"]["return_mean"])
    return [(_read_rung(variant, rung, deterministic), {"rung": int(rung["steps"])})]


def _random(variant: Variant, deterministic: bool) -> list[_Maker]:
    return [(random_policy(variant.robot), {})]


def _medium_expert(variant: Variant, deterministic: bool) -> list[_Maker]:
    ((medium, attributes),) = _medium(variant, deterministic)
    expert = expert_actor(variant, deterministic=deterministic)
    return [(medium, attributes | {"part": MEDIUM}), (expert, {"part": EXPERT})]


def _ranked(variant: Variant, deterministic: bool) -> list[_Maker]:
    """Return the expert and the rungs whose returns are spread most evenly below it, the best first."""
    rungs = ladder(variant)
    expert_return = expert_record(variant)["evaluation"]["return_mean"]
    below = [rung for rung in rungs if _mean_return(rung) < expert_return]
    if len(below) < RANKS - 1:
        raise PolicyNotFoundError(
            f"{variant} has {len(below)} rungs below its expert; the tier {RANKED} needs {RANKS - 1}"
        )
    chosen: list[Mapping[str, Any]] = []
    for rank in range(1, RANKS):
        wanted = expert_return * (1 - rank / RANKS)
        chosen.append(min((r for r in below if r not in chosen), key=lambda r: abs(_mean_return(r) - wanted)))
    chosen.sort(key=_mean_return, reverse=True)
    expert = expert_actor(variant, deterministic=deterministic)
    ranked: list[_Maker] = [(expert, {"rank": 0, "policy_return": expert_return})]
    for rank, rung in enumerate(chosen, start=1):
        attributes = {"rank": rank, "policy_return": _mean_return(rung), "rung": int(rung["steps"])}
        ranked.append((_read_rung(variant, rung, deterministic), attributes))
    return ranked


_MAKERS: dict[str, Callable[[Variant, bool], list[_Maker]]] = {
    EXPERT: _expert,
    EXPERT_STOCHASTIC: _expert_stochastic,
    MEDIUM: _medium,
    RANDOM: _random,
    MEDIUM_EXPERT: _medium_expert,
    RANKED: _ranked,
}
_ONE_POLICY = (EXPERT, EXPERT_STOCHASTIC, MEDIUM, RANDOM)


def _read_rung(variant: Variant, rung: Mapping[str, Any], deterministic: bool) -> Actor:
    name = rung_file(variant, rung["steps"])
    path = find_policy_file(name)
    if path is None:
        raise PolicyNotFoundError(f"the training record of {variant} names {name}, which is missing")
    algorithm = expert_record(variant)["algorithm"]
    return read_actor(path, deterministic=deterministic, algorithm=algorithm).for_robot(variant.robot)


def _mean_return(rung: Mapping[str, Any]) -> float:
    return float(rung["evaluation"]["return_mean"])
