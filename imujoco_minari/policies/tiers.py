"""Tiers: the policies that make a dataset, and the number of episodes that each of them makes.

``medium`` is one rung of the variant's ladder. ``medium-expert`` is that rung and the expert, in equal parts.
``ranked`` is the expert and several rungs, in equal parts; each episode states its policy's rank and return.
``expert-stochastic`` samples the expert's actions. ``replay`` and ``medium-replay`` are recorded while a
policy is trained, so no policy of this module makes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from imujoco_minari.errors import DatasetError, PolicyNotFoundError, suggestion
from imujoco_minari.policies.actors import Policy
from imujoco_minari.policies.experts import expert_actor, universal_policy
from imujoco_minari.policies.files import read_actor
from imujoco_minari.policies.references import ladder, measured_record
from imujoco_minari.policies.rungs import RANKED_SHARES, mean_return, medium_rung, ranked_rungs, read_rung
from imujoco_minari.policies.uniform import random_policy
from imujoco_minari.policies.universal import UniversalPolicy
from imujoco_minari.storage.missing import making
from imujoco_minari.variants import EXPERT, Variant

EXPERT_STOCHASTIC, RANDOM, MEDIUM = "expert-stochastic", "random", "medium"
MEDIUM_EXPERT, RANKED, MEDIUM_REPLAY, REPLAY = "medium-expert", "ranked", "medium-replay", "replay"
TIERS = (EXPERT, EXPERT_STOCHASTIC, MEDIUM, RANDOM, MEDIUM_EXPERT, RANKED, MEDIUM_REPLAY, REPLAY)
# These have the policies of the tier without the ending, and are meant to have more episodes.
LARGE = "-large"
LARGE_TIERS = (MEDIUM + LARGE, MEDIUM_EXPERT + LARGE)
# Tiers that are recorded while a policy is trained.
RECORDED = (MEDIUM_REPLAY, REPLAY)

_ONE_POLICY = (EXPERT, EXPERT_STOCHASTIC, MEDIUM, RANDOM)

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

    policy: Policy | UniversalPolicy
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
        VariantError: if ``variant`` names no variant.
        PolicyNotFoundError: if no single policy makes the tier, or ``path`` does not exist.
        PolicyError: if the file holds no actor, or the actor does not fit the robot.

    Examples:
        >>> load_policy("hopper-base")
        Actor(CrossQ, layers 11-256-256-3, ReLU, deterministic)
    """
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
        PolicyNotFoundError: if no policy makes the tier, or a policy of the variant is missing.
        PolicyError: if a file holds no actor, or the actor does not fit the robot.
        DatasetError: if the episodes cannot be divided equally among the policies.
    """
    makers = _makers(variant, tier, path, stochastic)
    if episodes % len(makers):
        raise DatasetError(
            f"{len(makers)} policies make equal parts of the tier {tier}: {episodes} episodes cannot be "
            f"divided by {len(makers)}"
        )
    return [TierPart(policy, episodes // len(makers), attributes) for policy, attributes in makers]


def range_parts(
    robot: str, tier: str, episodes: int, *, path: Path | None, stochastic: bool
) -> list[TierPart]:
    """Return the parts of a dataset whose episodes draw their variants from ranges.

    Its expert is the universal policy, which is told the variant of each episode. All other policies are
    those of the base, as for :func:`parts`. Without a universal policy, the expert is the base's too.

    Raises:
        ImujocoError: what :func:`parts` raises.
    """
    universal = universal_policy(robot) if path is None and tier in (EXPERT, EXPERT_STOCHASTIC) else None
    if universal is None:
        return parts(Variant(robot), tier, episodes, path=path, stochastic=stochastic)
    policy = replace(universal, deterministic=tier == EXPERT and not stochastic)
    return [TierPart(policy, episodes)]


def _makers(variant: Variant, tier: str, path: str | Path | None, stochastic: bool) -> list[_Maker]:
    """Return the policies that make a dataset; each makes the same number of episodes."""
    if path is not None:
        return [(read_actor(path, deterministic=not stochastic).for_robot(variant.robot), {})]
    if tier in RECORDED:
        raise PolicyNotFoundError(
            f"no single policy makes the tier {tier}: it is recorded while a policy is trained, "
            f"with `{making(variant.dataset_id(tier))}`"
        )
    tier = tier.removesuffix(LARGE) if tier in LARGE_TIERS else tier
    if tier not in TIERS:
        near = suggestion(tier, TIERS) if isinstance(tier, str) else ""
        raise PolicyNotFoundError(
            f"no policy makes the tier {tier!r}{near}; "
            f"valid: {', '.join((*TIERS, *LARGE_TIERS))}, or any name with --policy FILE"
        )
    deterministic = not stochastic and tier != EXPERT_STOCHASTIC
    if tier == RANDOM:
        return [(random_policy(variant.robot), {})]
    if tier in (EXPERT, EXPERT_STOCHASTIC):
        return [(expert_actor(variant, deterministic=deterministic), {})]
    if tier == RANKED:
        return _ranked(variant, deterministic)
    rung = medium_rung(ladder(variant), measured_record(variant))
    medium = read_rung(variant, rung, deterministic=deterministic)
    attributes: dict[str, Any] = {"rung": int(rung["steps"])}
    if tier == MEDIUM:
        return [(medium, attributes)]
    expert = expert_actor(variant, deterministic=deterministic)
    return [(medium, attributes | {"part": MEDIUM}), (expert, {"part": EXPERT})]


def _ranked(variant: Variant, deterministic: bool) -> list[_Maker]:
    """Return the expert and the rungs whose returns are spread most evenly below it, the best first."""
    rungs, expert = ladder(variant), expert_actor(variant, deterministic=deterministic)
    record = measured_record(variant)
    chosen = ranked_rungs(rungs, record)
    if len(chosen) < len(RANKED_SHARES):
        raise PolicyNotFoundError(
            f"{variant} has {len(chosen)} rungs below its expert; "
            f"the tier {RANKED} needs {len(RANKED_SHARES)}"
        )
    ranked: list[_Maker] = [(expert, {"rank": 0, "policy_return": mean_return(record)})]
    for rank, rung in enumerate(chosen, start=1):
        attributes = {"rank": rank, "policy_return": mean_return(rung), "rung": int(rung["steps"])}
        ranked.append((read_rung(variant, rung, deterministic=deterministic), attributes))
    return ranked
