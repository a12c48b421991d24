"""Makes the canonical MJCF text of a variant, which training, collection, rendering and verification compile.

It starts from the robot's Gymnasium v5 model and first writes the compiled inertias into it. This removes
HalfCheetah's ``settotalmass``, which would rescale every limb when one changes, and leaves every field of
the compiled model the same to the bit. Then one function for each category edits the model.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import lru_cache
from importlib import resources

import mujoco
import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import ModelError
from imujoco_minari.variants import BASE, Variant, specification
from imujoco_minari.variants.original import OriginalVariant

Floats = NDArray[np.float64]


@lru_cache(maxsize=256)
def canonical_mjcf(variant: Variant) -> str:
    """Return the canonical MJCF text of ``variant``. Compiling it gives the edited model to the last bit.

    Raises:
        ModelError: when MuJoCo cannot compile the edited model.
    """
    return _edited(variant)[0]


def model_text(variant: Variant, mjcf: str | None = None) -> str:
    """Return the MJCF text that an environment of ``variant`` runs.

    Args:
        variant: ours, with the canonical text, or a variant of the original archive.
        mjcf: the text of the latter, which does not follow from its id.

    Raises:
        ModelError: when a variant of the archive has no text.
    """
    if not isinstance(variant, OriginalVariant):
        return canonical_mjcf(variant)
    if mjcf is None:
        raise ModelError(f"{variant} is a variant of the original archive and needs the text of its model")
    return mjcf


def mjcf_sha256(text: str) -> str:
    """Return the hexadecimal SHA-256 of an MJCF text."""
    return hashlib.sha256(text.encode()).hexdigest()


def healthy_z_range(variant: Variant) -> tuple[float, float] | None:
    """Return the torso heights (m) outside which an episode of ``variant`` ends; None where none does.

    The root of a length variant is raised or lowered so that it stands on the floor. The range moves with it.
    """
    base = specification(variant.robot).healthy_z_range
    if base is None:
        return None
    shift = root_shift(variant)
    return base[0] + shift, base[1] + shift


@lru_cache(maxsize=256)
def root_shift(variant: Variant) -> float:
    """Return the height (m) of the root of ``variant`` above the base robot's."""
    return _edited(variant)[1]


def compile_mjcf(text: str) -> mujoco.MjModel:
    """Compile an MJCF text.

    Raises:
        ModelError: when MuJoCo cannot compile it.
    """
    try:
        return mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        raise ModelError(f"MuJoCo cannot compile the model: {error}") from None


def lowest_point(model: mujoco.MjModel) -> float:
    """Return the height (m) of the lowest point of the robot's capsules in the rest pose, floor at 0."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    capsules = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE)
    axis_z = data.geom_xmat.reshape(-1, 3, 3)[capsules, 2, 2]
    radius, half = model.geom_size[capsules, 0], model.geom_size[capsules, 1]
    return float(np.min(data.geom_xpos[capsules, 2] - np.abs(axis_z) * half - radius))


def _edited(variant: Variant) -> tuple[str, float]:
    spec = _baked(variant.robot)
    shift = _EDITS[variant.category](spec, variant) if variant.category != BASE else 0.0
    try:
        spec.compile()
        return str(spec.to_xml()), shift
    except ValueError as error:
        raise ModelError(f"{variant}: MuJoCo cannot compile the edited model: {error}") from None


def _baked(robot: str) -> mujoco.MjSpec:
    """Return the base robot's spec with its compiled inertias written out."""
    asset = resources.files("gymnasium.envs.mujoco") / "assets" / specification(robot).model
    return bake(asset.read_text("utf-8"))


def bake(text: str) -> mujoco.MjSpec:
    """Return the spec of an MJCF text, with the compiled inertias written out. All bodies must have names."""
    spec = mujoco.MjSpec.from_string(text)
    # to_xml() would otherwise round what it writes to six digits.
    spec.compiler.savecompiled = False
    total_mass, spec.compiler.settotalmass = spec.compiler.settotalmass, -1.0
    stock = _compiled(spec)
    if total_mass > 0:
        mujoco.mj_setTotalmass(stock, total_mass)
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    for body in spec.bodies[1:]:
        compiled = stock.body(body.name)
        body.explicitinertial = True
        body.mass = compiled.mass[0]
        body.inertia = compiled.inertia
        body.ipos = compiled.ipos
        body.iquat = compiled.iquat
    return spec


def _compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Return the model of a copy of a spec. Compiling the spec itself would fix its inertias."""
    return spec.copy().compile()


def _edit_mass(spec: mujoco.MjSpec, variant: Variant) -> float:
    """Scale the mass of the body's one geom, and its inertia with it."""
    for body in _bodies(spec, variant):
        body.mass *= variant.factor
        body.inertia = body.inertia * variant.factor
    return 0.0


def _edit_joint(spec: mujoco.MjSpec, variant: Variant) -> float:
    """Scale both ends of the joint's range."""
    for name in variant.mjcf_names:
        joint = spec.joint(name)
        joint.range = joint.range * variant.factor
    return 0.0


def _edit_length(spec: mujoco.MjSpec, variant: Variant) -> float:
    """Stretch the capsule away from its joint, move its child bodies, and stand the robot on the floor."""
    base = _compiled(spec)
    clearance = lowest_point(base)
    for body in _bodies(spec, variant):
        _stretch(body, _capsule_axis(base, body.geoms[0].name), variant)
    shift = clearance - lowest_point(_compiled(spec))
    root = spec.bodies[1]
    root.pos = root.pos + [0.0, 0.0, shift]
    for joint in root.joints:
        if joint.ref != 0.0:
            # Where the vertical slide's value is the torso's height, it still is.
            joint.ref += shift
            joint.pos = joint.pos - [0.0, 0.0, shift]
    return shift


def _edit_friction(spec: mujoco.MjSpec, variant: Variant) -> float:
    """Scale the sliding friction of the contacts between feet and floor, and of no other contacts.

    A contact takes the larger friction of its two geoms, so a smaller friction of the foot alone would
    change little or nothing. An explicit contact pair overrides both. Its other parameters are those that
    MuJoCo derives from the two geoms.
    """
    floor = spec.geom("floor")
    for name in variant.mjcf_names:
        foot = spec.geom(name)
        slide, spin, roll = np.maximum(foot.friction, floor.friction)
        slide *= variant.factor
        pair = spec.add_pair(geomname1="floor", geomname2=name)
        pair.condim = max(foot.condim, floor.condim)
        pair.friction = [slide, slide, spin, roll, roll]
        pair.solref = (foot.solref + floor.solref) / 2
        pair.solimp = (foot.solimp + floor.solimp) / 2
        pair.margin = foot.margin + floor.margin
        pair.gap = foot.gap + floor.gap
    return 0.0


_EDITS: dict[str, Callable[[mujoco.MjSpec, Variant], float]] = {
    "mass": _edit_mass,
    "joint": _edit_joint,
    "length": _edit_length,
    "friction": _edit_friction,
}


def _bodies(spec: mujoco.MjSpec, variant: Variant) -> list[mujoco.MjsBody]:
    bodies = [spec.geom(name).parent for name in variant.mjcf_names]
    for body in bodies:
        if len(body.geoms) != 1:
            raise ModelError(f"{variant}: body {body.name!r} has several geoms, and one cannot change alone")
    return bodies


def _stretch(body: mujoco.MjsBody, axis: Floats, variant: Variant) -> None:
    """Scale the segment of a limb's capsule by the variant's factor, radius and density kept.

    The point of the segment nearest to the limb's joint stays where it is: an end for most limbs, the
    ankle for Hopper's foot, whose heel stands out behind it; the centre for the torso. Child bodies
    move with the end they hang on.
    """
    factor, root_joints = variant.factor, specification(variant.robot).root_joints
    if factor == 1.0:
        # From mass to density and back would cost the last bit.
        return
    geom = body.geoms[0]
    radius, half = geom.size[0], geom.size[1]
    centre = np.array(geom.pos)
    density = body.mass / _capsule_volume(radius, half)
    hinges = [joint for joint in body.joints if joint.name not in root_joints]
    fixed = 0.0 if not hinges else float(np.clip((hinges[0].pos - centre) @ axis, -half, half))

    def moved(along: float) -> Floats:
        return (factor - 1.0) * (along - fixed) * axis

    for child in body.bodies:
        along = (_attachment(child) - centre) @ axis
        child.pos = child.pos + moved(half if along >= fixed else -half)
    geom.pos = centre + moved(0.0)
    geom.size = [radius, half * factor, 0.0]
    # Undefined again, the body's inertia follows from its geom.
    geom.density = density
    body.explicitinertial = False
    body.ipos = np.full(3, np.nan)
    body.mass, body.inertia, body.iquat = 0.0, np.zeros(3), [1.0, 0.0, 0.0, 0.0]


def _attachment(child: mujoco.MjsBody) -> Floats:
    """Return where (m, in the parent's frame) a child body is hinged to its parent."""
    # None of the robots' bodies is rotated against its parent in the rest pose.
    return np.asarray(child.pos + child.joints[0].pos, dtype=np.float64)


def _capsule_axis(model: mujoco.MjModel, name: str) -> Floats:
    """Return the unit vector of a capsule's axis in its body's frame."""
    axis = np.empty(3)
    mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), model.geom(name).quat)
    return axis


def _capsule_volume(radius: float, half: float) -> float:
    return float(np.pi * radius**2 * (2.0 * half + 4.0 / 3.0 * radius))
