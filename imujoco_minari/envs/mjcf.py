"""Makes the model of a variant: its canonical MJCF text, and the same model compiled without the text.

It starts from the robot's Gymnasium v5 model and first writes the compiled inertias into it. This removes
HalfCheetah's ``settotalmass``, which would rescale every limb when one changes, and leaves every field of
the compiled model the same to the bit. Then the variant's category edits the model.
"""

from __future__ import annotations

import hashlib
from copy import copy
from functools import lru_cache
from importlib import resources
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from imujoco_minari.envs.categories import BY_NAME, Edit
from imujoco_minari.envs.categories.capsules import compile_shape
from imujoco_minari.envs.categories.interface import find
from imujoco_minari.envs.untrusted_mjcf import check_mjcf
from imujoco_minari.errors import ModelError
from imujoco_minari.variants import Variant, carried_page, specification
from imujoco_minari.variants.original import OriginalVariant
from imujoco_minari.variants.robots import follows_page

Floats = NDArray[np.float64]


@follows_page
@lru_cache(maxsize=256)
def canonical_mjcf(variant: Variant | str) -> str:
    """Return the canonical MJCF text of a variant. Compiling it gives the edited model to the last bit.

    Args:
        variant: a variant or its id.

    Raises:
        VariantError: when ``variant`` is not a variant id.
        ModelError: when MuJoCo cannot compile the edited model.
    """
    return str(_edited(Variant.parse(variant)).spec.to_xml())


def variant_model(variant: Variant) -> mujoco.MjModel:
    """Return a new compiled model of ``variant``.

    It equals ``compile_mjcf(canonical_mjcf(variant))`` in every byte, but writes and reads no text. That
    takes a third of the time, which counts where each episode has another variant.
    """
    return copy(_edited(variant).model)


def model_text(variant: Variant, mjcf: str | None = None) -> str:
    """Return the MJCF text that an environment of ``variant`` runs: ours, or ``mjcf`` for the archive's.

    Raises:
        ModelError: when a variant of the original archive has no text.
    """
    if not isinstance(variant, OriginalVariant):
        return canonical_mjcf(variant)
    if mjcf is None:
        raise ModelError(f"{variant} is a variant of the original archive and needs the text of its model")
    return mjcf


def mjcf_sha256(text: str) -> str:
    """Return the hexadecimal SHA-256 of an MJCF text."""
    return hashlib.sha256(text.encode()).hexdigest()


@follows_page
@lru_cache(maxsize=256)
def healthy_z_range(variant: Variant) -> tuple[float, float] | None:
    """Return the torso heights (m) outside which an episode of ``variant`` ends; None where none does.

    The root of a length variant is raised or lowered so that it stands on the floor. The range moves with it.
    """
    base = specification(variant.robot).healthy_z_range
    if base is None:
        return None
    shift = _edited(variant).root_shift
    return base[0] + shift, base[1] + shift


def compile_mjcf(text: str) -> mujoco.MjModel:
    """Compile an MJCF text; raise a ModelError when MuJoCo cannot."""
    try:
        return mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        raise ModelError(f"MuJoCo cannot compile the model: {error}") from None


def round_geoms(model: mujoco.MjModel) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Return the robot's capsules and spheres: their indices, radii (m), and half lengths of their axes (m).

    The half length of a sphere is 0.
    """
    sphere = model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
    found = np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE) | sphere)
    return found, model.geom_size[found, 0], np.where(sphere[found], 0.0, model.geom_size[found, 1])


def lowest_point(model: mujoco.MjModel) -> float:
    """Return the height (m) of the lowest point of the robot's capsules and spheres in the rest pose."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found, radius, half = round_geoms(model)
    if not len(found):
        raise ModelError("the robot has no capsule and no sphere, so its height is not known")
    axis_z = data.geom_xmat.reshape(-1, 3, 3)[found, 2, 2]
    return float(np.min(data.geom_xpos[found, 2] - np.abs(axis_z) * half - radius))


def check_robot(robot: str) -> None:
    """Compile the unchanged model of a robot.

    Raises:
        ModelError: when the model is refused, does not compile, or lacks a part that the robot's page names.
    """
    page, text = specification(robot), base_text(robot)
    try:
        spec, _ = _base(text)
        for name in (*page.root_joints, *page.stance):
            find(spec, "joint", name)
        for name in page.feet:
            find(spec, "geom", name)
        for category, listing in page.categories.items():
            for names in listing.bodies.values():
                for name in names:
                    find(spec, BY_NAME[category].part, name)
    except (ModelError, ValueError) as error:
        raise ModelError(f"{robot}: {error}") from None


class _Edited(NamedTuple):
    spec: mujoco.MjSpec
    model: mujoco.MjModel
    root_shift: float


@follows_page
@lru_cache(maxsize=4)
def _edited(variant: Variant) -> _Edited:
    """Apply the changes of a variant to its robot's model, in their order, and stand it on the floor."""
    page, shift = specification(variant.robot), 0.0
    text = base_text(variant.robot)
    unchanged, base = _base(text)
    spec = unchanged.copy()
    try:
        for change in variant.changes:
            names = change.mjcf_names(variant.robot)
            BY_NAME[change.category].apply(Edit(spec, names, change.factor, page, base))
        if page.root_joints and any(BY_NAME[change.category].moves_limbs for change in variant.changes):
            shift = _stand(spec, _clearance(text))
        return _Edited(spec, spec.compile(), shift)
    except ModelError as error:
        raise ModelError(f"{variant}: {error}") from None
    except ValueError as error:
        raise ModelError(f"{variant}: MuJoCo cannot compile the edited model: {error}") from None


def _stand(spec: mujoco.MjSpec, clearance: float) -> float:
    """Raise the root until the lowest point of the rest pose is at ``clearance`` (m); return by how much."""
    shift = clearance - lowest_point(compile_shape(spec))
    root = spec.bodies[1]
    root.pos = root.pos + [0.0, 0.0, shift]
    for joint in root.joints:
        if joint.ref != 0.0:
            # Where the vertical slide's value is the torso's height, it still is.
            joint.ref += shift
            joint.pos = joint.pos - [0.0, 0.0, shift]
    return shift


@lru_cache(maxsize=16)
def _base(text: str) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """Return the spec of an unchanged robot, with its inertias written out, and its model."""
    spec = bake(text)
    return spec, compile_shape(spec)


@lru_cache(maxsize=16)
def _clearance(text: str) -> float:
    return lowest_point(_base(text)[1])


def base_text(robot: str) -> str:
    """Return the MJCF text of a robot's unchanged model, as its page names it.

    Raises:
        ModelError: when the text of a user's robot is refused, or Gymnasium has no such asset.
    """
    page = carried_page(robot)
    if page is not None and "mjcf" in page:
        check_mjcf(page["mjcf"], robot)
        return page["mjcf"]
    name = specification(robot).model
    asset = resources.files("gymnasium.envs.mujoco") / "assets" / name
    if not asset.is_file():
        raise ModelError(f"{robot}: its model {name} is neither beside its page nor one of Gymnasium's")
    return asset.read_text("utf-8")


def bake(text: str) -> mujoco.MjSpec:
    """Return the spec of an MJCF text, with the compiled inertias written out."""
    spec = mujoco.MjSpec.from_string(text)
    # to_xml() would otherwise round what it writes to six digits.
    spec.compiler.savecompiled = False
    total_mass, spec.compiler.settotalmass = spec.compiler.settotalmass, -1.0
    copied = spec.copy()
    stock = copied.compile()
    if total_mass > 0:
        mujoco.mj_setTotalmass(stock, total_mass)
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    for body, twin in zip(spec.bodies[1:], copied.bodies[1:], strict=True):
        compiled = stock.body(twin.id)
        body.explicitinertial = True
        body.mass = compiled.mass[0]
        body.inertia = compiled.inertia
        body.ipos = compiled.ipos
        body.iquat = compiled.iquat
    return spec
