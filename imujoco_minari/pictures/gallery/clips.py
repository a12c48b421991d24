"""The gallery's pictures: a short clip and a portrait of each variant.

Each picture has a key, the digest of everything that decides it (model, policy, size, seconds). A later run
draws only pictures with a new key. It needs no OpenGL if there are none.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from imujoco_minari.envs.mjcf import Floats, canonical_mjcf, mjcf_sha256, variant_model
from imujoco_minari.errors import PolicyNotFoundError
from imujoco_minari.pictures.gallery.entries import Clip
from imujoco_minari.pictures.rendering.files import write_picture, write_video
from imujoco_minari.pictures.rendering.film import frames, stride
from imujoco_minari.pictures.rendering.framing import Capsules, capsules, follow
from imujoco_minari.pictures.rendering.motion import Motion, perform
from imujoco_minari.pictures.rendering.studio import Studio
from imujoco_minari.policies import Policy, load_policy
from imujoco_minari.policies.tiers import RANDOM
from imujoco_minari.variants import EXPERT, Variant, catalogue, specification

SIZE = (320, 240)
SECONDS, FRAMES_PER_SECOND, QUALITY = 4.0, 20.0, 30
# An episode that ends at once would flicker in a loop, so its last frame stays for a second.
REST_SECONDS = 1.0
# Increase this number when the look of the pictures changes.
STYLE = 2


def draw(variant: Variant, folder: Path, studio: Studio, known: dict[str, Any]) -> bool:
    """Draw a variant's clip and portrait into a site, and return whether it was necessary.

    ``known`` holds ``key`` and ``clip`` of an earlier run, or nothing. It is updated.
    """
    policy, tier = choose_policy(variant)
    key = clip_key(variant, policy)
    clip, portrait = folder / "clips" / f"{variant}.mp4", folder / "portraits" / f"{variant}.webp"
    if known.get("key") == key and clip.is_file() and portrait.is_file():
        return False
    motion = perform(variant, policy, seconds=SECONDS)
    write_clip(motion, studio, clip)
    write_portrait(variant, studio, portrait)
    content = Clip(tier, motion.duration, motion.total, motion.terminated)
    known.update(key=key, clip=asdict(content))
    return True


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
    lengths = (other for other in catalogue(variant.robot) if other.category == "length")
    seen = [_stance_capsules(each) for each in (variant, *lengths)]
    camera = follow(seen, studio.aspect, 1.0)[0]
    write_picture(path, next(studio.shoot(variant, [stance(variant)], camera)))


def stance(variant: Variant) -> Floats:
    """Return the positions (nq,) of a variant in its robot's stance, with its lowest point on the floor.

    Angles are clipped to the ranges of the variant's joints.
    """
    model = variant_model(variant)
    data, page = mujoco.MjData(model), specification(variant.robot)
    for name, degrees in page.stance.items():
        joint, angle = model.joint(name), np.radians(degrees)
        data.qpos[joint.qposadr[0]] = np.clip(angle, *joint.range) if model.jnt_limited[joint.id] else angle
    height = _height_index(model)
    if height is not None:
        seen = capsules(model, data.qpos[None])
        data.qpos[height] -= (seen.ends[0, :, 2] - seen.radii).min()
    return np.array(data.qpos)


def _height_index(model: mujoco.MjModel) -> int | None:
    """Return the index of the root's height in the positions; None for a robot that moves on a level."""
    for joint in range(model.body_jntadr[1], model.body_jntadr[1] + model.body_jntnum[1]):
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            return int(model.jnt_qposadr[joint]) + 2
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE and model.jnt_axis[joint][2] == 1.0:
            return int(model.jnt_qposadr[joint])
    return None


@cache
def _stance_capsules(variant: Variant) -> Capsules:
    """Return the capsules of a variant in its stance."""
    return capsules(variant_model(variant), stance(variant)[None])


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
