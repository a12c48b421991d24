"""The stance of a portrait: all variants of a robot stand alike, for comparison."""

from __future__ import annotations

import mujoco
import numpy as np

from imujoco_minari.envs.mjcf import canonical_mjcf, compile_mjcf
from imujoco_minari.pictures.rendering.framing import capsules
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
