"""The gallery's pictures: a short clip and a portrait of each variant.

Each picture has a key, the digest of everything that decides it (model, policy, size, seconds). A later run
draws only pictures with a new key. It needs no OpenGL if there are none.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from imujoco_minari.envs.mjcf import canonical_mjcf, compile_mjcf, mjcf_sha256
from imujoco_minari.errors import PolicyNotFoundError
from imujoco_minari.pictures.gallery.entries import Clip
from imujoco_minari.pictures.rendering.files import write_picture, write_video
from imujoco_minari.pictures.rendering.film import frames, stride
from imujoco_minari.pictures.rendering.framing import Capsules, capsules, follow
from imujoco_minari.pictures.rendering.motion import Motion, perform
from imujoco_minari.pictures.rendering.portraits import stance
from imujoco_minari.pictures.rendering.studio import Studio
from imujoco_minari.policies import Policy, load_policy
from imujoco_minari.policies.tiers import RANDOM
from imujoco_minari.variants import EXPERT, Variant, catalogue

SIZE = (320, 240)
SECONDS, FRAMES_PER_SECOND, QUALITY = 4.0, 20.0, 30
# An episode that ends at once would flicker in a loop, so its last frame stays for a second.
REST_SECONDS = 1.0
# Increase this number when the look of the pictures changes.
STYLE = 2


def draw(variant: Variant, folder: Path, studio: Studio, known: Mapping[str, Any]) -> tuple[Clip, str, bool]:
    """Draw a variant's clip and portrait into a site, unless an earlier run has drawn the same.

    Args:
        variant: the variant.
        folder: the site's folder.
        studio: the renderer.
        known: ``key`` and ``clip`` of an earlier run, or empty.

    Returns:
        The content of the clip, its key, and whether it was drawn now.

    Raises:
        RenderingError: if no OpenGL works.
        StorageError: if a file cannot be written.
        PolicyError: if the variant's policy cannot be read.
    """
    policy, tier = choose_policy(variant)
    key = clip_key(variant, policy)
    clip, portrait = folder / "clips" / f"{variant}.mp4", folder / "portraits" / f"{variant}.webp"
    if known.get("key") == key and clip.is_file() and portrait.is_file():
        return Clip(**known["clip"]), key, False
    motion = perform(variant, policy, seconds=SECONDS)
    write_clip(motion, studio, clip)
    write_portrait(variant, studio, portrait)
    return Clip(tier, motion.duration, motion.total, motion.terminated), key, True


def write_clip(motion: Motion, studio: Studio, path: Path) -> None:
    """Write a motion as a video."""
    every = stride([motion], FRAMES_PER_SECOND)
    rest = round(REST_SECONDS / motion.timestep) if motion.terminated else 0
    steps = range(0, len(motion.rewards) + rest + 1, every)
    pictures = frames([motion], studio, steps, captions=False)
    write_video(path, pictures, 1.0 / (every * motion.timestep), quality=QUALITY)


def write_portrait(variant: Variant, studio: Studio, path: Path) -> None:
    """Write a picture of a variant in its stance."""
    # The variants of other lengths are framed too, so all portraits of a robot have the same distance.
    seen = [_stance_capsules(each) for each in (variant, *catalogue(variant.robot, "length"))]
    camera = follow(seen, studio.aspect, 1.0)[0]
    shot = next(studio.shoot(variant, [stance(variant)], camera))
    write_picture(path, Image.fromarray(np.ascontiguousarray(shot)))


@cache
def _stance_capsules(variant: Variant) -> Capsules:
    """Return the capsules of a variant in its stance."""
    return capsules(compile_mjcf(canonical_mjcf(variant)), stance(variant)[None])


def choose_policy(variant: Variant) -> tuple[Policy, str]:
    """Return the policy of a variant's clip and its tier: the expert, or random if there is none."""
    try:
        return load_policy(variant), EXPERT
    except PolicyNotFoundError:
        return load_policy(variant, tier=RANDOM), RANDOM


def clip_key(variant: Variant, policy: Policy) -> str:
    """Return the digest of everything that decides a variant's pictures."""
    settings = (STYLE, SIZE, SECONDS, FRAMES_PER_SECOND, QUALITY, REST_SECONDS)
    parts = (*settings, mjcf_sha256(canonical_mjcf(variant)), policy.sha256)
    return hashlib.sha256(repr(parts).encode()).hexdigest()
