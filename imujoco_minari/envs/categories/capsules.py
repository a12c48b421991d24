"""The categories that change the shape of a limb, which is one capsule: its length, and its thickness.

The density stays, so the mass changes with the shape.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from imujoco_minari.envs.categories.interface import CategoryLaw, Edit, find_all
from imujoco_minari.errors import ModelError

Floats = NDArray[np.float64]

# The fields of the compiled model that follow from the shape of a limb.
_FIELDS = frozenset(
    (
        *("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "geom_size", "geom_pos"),
        *("qpos0", "jnt_pos", "body_sameframe", "geom_sameframe", "body_simple"),
    )
)


def compile_shape(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Return the model of a copy of a spec, to measure it. Compiling the spec itself would fix its inertias.

    Its textures are one pixel: they take three quarters of the time of compiling.
    """
    copied = spec.copy()
    for texture in copied.textures:
        texture.width = texture.height = 1
    return copied.compile()


def _reshape(edit: Edit, body: mujoco.MjsBody, *, length: float = 1.0, radius: float = 1.0) -> None:
    """Scale the length of the segment of a body that is one capsule, and its radius. The density stays.

    The point of the segment nearest to the limb's joint stays where it is, or the centre if the limb has no
    joint of its own. Child bodies move with the end that they are attached to.
    """
    if len(body.geoms) != 1 or body.geoms[0].type != mujoco.mjtGeom.mjGEOM_CAPSULE:
        raise ModelError(f"body {body.name!r} is not one capsule, so its shape cannot change")
    numbers = {each: number for number, each in enumerate(edit.spec.bodies)}
    # The base model serves after other changes too: they turn no limb. A changed geom states its own shape.
    model, geom = edit.base, body.geoms[0]
    index = model.body_geomadr[numbers[body]]
    axis = _rotated(np.array([0.0, 0.0, 1.0]), model.geom_quat[index])
    if not np.isnan(geom.fromto[0]):
        # The ends of the segment would override the position, the rotation and the length.
        geom.fromto = np.full(6, np.nan)
        geom.pos, geom.quat = model.geom_pos[index], model.geom_quat[index]
        geom.size = model.geom_size[index]
    thickness, half = geom.size[0], geom.size[1]
    centre = np.array(geom.pos)
    volume = float(np.pi * thickness**2 * (2.0 * half + 4.0 / 3.0 * thickness))
    density = body.mass / volume if body.explicitinertial else geom.density
    hinges = [joint for joint in body.joints if joint.name not in edit.page.root_joints]
    fixed = 0.0 if not hinges else float(np.clip((hinges[0].pos - centre) @ axis, -half, half))

    def moved(along: float) -> Floats:
        return (length - 1.0) * (along - fixed) * axis

    if length != 1.0:
        for child in body.bodies:
            along = (_attachment(child, model.body_quat[numbers[child]]) - centre) @ axis
            child.pos = child.pos + moved(half if along >= fixed else -half)
        geom.pos = centre + moved(0.0)
    geom.size = [thickness * radius, half * length, 0.0]
    # Undefined again, the body's inertia follows from its geom.
    geom.density = density
    body.explicitinertial = False
    body.ipos = np.full(3, np.nan)
    body.mass, body.inertia, body.iquat = 0.0, np.zeros(3), [1.0, 0.0, 0.0, 0.0]


def _attachment(child: mujoco.MjsBody, quat: Floats) -> Floats:
    """Return where (m, in the parent's frame) a child body is attached: at its joint, or at its origin."""
    anchor = child.joints[0].pos if child.joints else np.zeros(3)
    return np.asarray(child.pos + _rotated(np.asarray(anchor), quat), dtype=np.float64)


def _rotated(vector: Floats, quat: Floats) -> Floats:
    result = np.empty(3)
    mujoco.mju_rotVecQuat(result, vector, quat)
    return result


def _reshaping(name: str, noun: str, dimension: str) -> CategoryLaw:
    """Return the category that scales ``length`` or ``radius`` of a limb."""

    def apply(edit: Edit) -> None:
        # From mass to density and back would cost the last bit.
        if edit.factor != 1.0:
            for body in find_all(edit, "limb"):
                _reshape(edit, body, **{dimension: edit.factor})

    return CategoryLaw(name, noun, noun, "limb", apply, _FIELDS, moves_limbs=True)


LENGTH = _reshaping("length", "length", "length")
SIZE = _reshaping("size", "thickness", "radius")
