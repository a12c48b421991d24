"""The motions to draw: a variant's or a recorded episode's, and the base robot's for comparison."""

from __future__ import annotations

from pathlib import Path

from imujoco_minari.errors import PolicyNotFoundError, RenderingError
from imujoco_minari.pictures.rendering.motion import Motion, perform, replay
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
    """Return the motion of a variant under its policy of a tier, or under a policy file.

    With ``beside_base``, the motion of the base robot comes first, under its own policy of the tier or under
    the same file. ``seconds`` is the length of the motions; None means the complete episode.

    Raises:
        PolicyNotFoundError: if there is no such policy.
    """
    variants = [variant.base, variant] if beside_base and variant != variant.base else [variant]
    title = f"{tier if policy is None else policy.stem} policy, seed {seed}"
    return [
        perform(each, load_policy(each, tier=tier, path=policy), seed=seed, seconds=seconds, title=title)
        for each in variants
    ]


def of_dataset(
    dataset_id: str, episode: int, *, beside_base: bool = False, seconds: float | None = None
) -> list[Motion]:
    """Return the motion of a recorded episode.

    With ``beside_base``, a motion of the base robot comes first: the episode of the same number in its
    dataset of the same tier, or without such a dataset, its policy of the tier. ``seconds`` is the length of
    the motions; None means the complete episode.

    Raises:
        DatasetNotFoundError: if there is no such dataset or episode.
        RenderingError: if the base robot has neither a dataset nor a policy of the tier.
    """
    motion = replay(dataset_id, episode).until(seconds)
    variant, tier = motion.variant, motion.tier
    if not beside_base or variant == variant.base:
        return [motion]
    base = variant.base.dataset_id(tier)
    if minari_root.exists(base):
        return [replay(base, episode).until(seconds), motion]
    try:
        policy = load_policy(variant.base, tier=tier)
    except PolicyNotFoundError:
        raise RenderingError(
            f"{variant.base} has no dataset and no policy of the tier {tier}: publish {base}, "
            "or leave out --beside-base"
        ) from None
    return [perform(variant.base, policy, seed=episode, seconds=seconds, title=f"{tier} policy"), motion]
