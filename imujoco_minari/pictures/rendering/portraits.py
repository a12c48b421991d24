"""Portraits: pictures of variants that stand in the same stance, for comparison."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from PIL import Image

from imujoco_minari.envs.mjcf import canonical_mjcf, compile_mjcf
from imujoco_minari.pictures.rendering.film import captioned, grid
from imujoco_minari.pictures.rendering.framing import capsules, follow
from imujoco_minari.pictures.rendering.studio import Studio
from imujoco_minari.variants import Variant, specification


def stance(variant: Variant) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return the positions (nq,) of a variant in its robot's stance, with its lowest point on the floor.

    Angles are clipped to the ranges of the variant's joints.
    """
    model = compile_mjcf(canonical_mjcf(variant))
    data, page = mujoco.MjData(model), specification(variant.robot)
    for name, degrees in page.stance.items():
        joint, angle = model.joint(name), np.radians(degrees)
        data.qpos[joint.qposadr[0]] = np.clip(angle, *joint.range) if model.jnt_limited[joint.id] else angle
    position = np.array(data.qpos)
    seen = capsules(model, position[None])
    lowest = (seen.ends[0, :, 2] - seen.radii).min()
    height = _height_index(model)
    if height is not None:
        position[height] -= lowest
    return position


def _height_index(model: mujoco.MjModel) -> int | None:
    """Return the index of the root's height in the positions; None for a robot that moves on a level."""
    for joint in range(model.body_jntadr[1], model.body_jntadr[1] + model.body_jntnum[1]):
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            return int(model.jnt_qposadr[joint]) + 2
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE and model.jnt_axis[joint][2] == 1.0:
            return int(model.jnt_qposadr[joint])
    return None


def portraits(variants: Sequence[Variant], studio: Studio) -> list[Image.Image]:
    """Return a portrait of each variant. The cameras have the same distance."""
    positions = [stance(variant) for variant in variants]
    seen = [
        capsules(studio.model(variant), position[None])
        for variant, position in zip(variants, positions, strict=True)
    ]
    cameras = follow(seen, studio.aspect, 1.0)
    return [
        Image.fromarray(np.ascontiguousarray(next(studio.shoot(variant, [position], camera))))
        for variant, position, camera in zip(variants, positions, cameras, strict=True)
    ]


def poster(rows: Sequence[Sequence[Variant]], size: tuple[int, int]) -> Image.Image:
    """Return one picture with rows of captioned variants. Each row has its own camera distance.

    Args:
        rows: rows of variants, each row of one robot.
        size: width and height of a portrait, in pixels.
    """
    with Studio(*size) as studio:
        cells = [
            captioned(picture, variant)
            for row in rows
            for variant, picture in zip(row, portraits(row, studio), strict=True)
        ]
    return grid(cells, len(rows[0]))
