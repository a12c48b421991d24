"""Whose motion is drawn: a variant's own, or a recorded episode, and the base robot's beside it."""

from __future__ import annotations

from pathlib import Path

from imujoco_minari.errors import PolicyNotFoundError, RenderingError
from imujoco_minari.pictures.rendering.motion import Motion, perform
from imujoco_minari.pictures.rendering.recorded import read_recorded, replay
from imujoco_minari.policies import load_policy
from imujoco_minari.storage import minari_root
from imujoco_minari.variants import Variant


def of_variant(
    variant: Variant,
    tier: str,
    policy: Path | None,
    *,
    seed: int = 0,
    beside_base: bool = False,
    seconds: float | None = None,
) -> list[Motion]:
    """Return the motion of ``variant`` under its policy of ``tier``, after the base robot's if asked for.

    The base robot is moved by its own policy of that tier; a policy file moves both.

    Raises:
        PolicyNotFoundError: when there is no such policy.
    """
    variants = [variant.base, variant] if beside_base and variant != variant.base else [variant]
    motions = []
    for each in variants:
        moved_by = tier if policy is None else policy.stem
        title = f"{moved_by} policy, seed {seed}"
        motions.append(
            perform(each, load_policy(each, tier=tier, path=policy), seed=seed, seconds=seconds, title=title)
        )
    return motions


def of_dataset(
    dataset_id: str, episode: int, *, beside_base: bool = False, seconds: float | None = None
) -> list[Motion]:
    """Return a recorded episode, replayed, after the base robot's if asked for.

    Beside it the base robot's dataset of the same tier shows its episode of the same number; where none
    is published here, the base robot's policy of that tier moves it.

    Raises:
        DatasetNotFoundError: when there is no such dataset or episode.
        RenderingError: when nothing of that tier can move the base robot.
    """
    recorded = read_recorded(dataset_id, episode)
    motions = [recorded.motion().until(seconds)]
    variant, tier = recorded.variant, recorded.tier
    if not beside_base or variant == variant.base:
        return motions
    base = variant.base.dataset_id(tier)
    if minari_root.exists(base):
        return [replay(base, episode).until(seconds), *motions]
    try:
        policy = load_policy(variant.base, tier=tier)
    except PolicyNotFoundError:
        raise RenderingError(
            f"nothing to show of {variant.base} beside it: publish {base}, or leave out --beside-base"
        ) from None
    return [perform(variant.base, policy, seed=episode, seconds=seconds, title=f"{tier} policy"), *motions]
