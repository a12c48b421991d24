"""The physical quantities that a variant changes, from its compiled model and that of its base robot."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from imujoco_minari.envs.categories.friction import contact_parameter
from imujoco_minari.envs.mjcf import canonical_mjcf, compile_mjcf, healthy_z_range
from imujoco_minari.variants import Variant


@dataclass(frozen=True)
class Difference:
    """One physical quantity before and after, in ``unit``."""

    quantity: str
    before: float
    after: float
    unit: str


def differences(variant: Variant) -> list[Difference]:
    """Return the physical quantities in which ``variant`` differs from its base robot."""
    models = (compile_mjcf(canonical_mjcf(each)) for each in (variant.base, variant))
    before, after = healthy_z_range(variant.base) or (), healthy_z_range(variant) or ()
    heights = zip(("lowest", "highest"), before, after, strict=False)
    quantities = [(f"{side} healthy height", first, second, "m") for side, first, second in heights]
    return model_differences(*models) + differing(quantities)


def differing(quantities: Iterable[tuple[str, float, float, str]]) -> list[Difference]:
    """Return the quantities, each a name, two values and a unit, whose values differ."""
    return [
        Difference(name, float(before), float(after), unit)
        for name, before, after, unit in quantities
        if not np.isclose(before, after, rtol=1e-9, atol=1e-12)
    ]


def model_differences(before: mujoco.MjModel, after: mujoco.MjModel) -> list[Difference]:
    """Return the quantities in which two compiled models of one robot differ.

    Bodies, geoms and joints are matched by name, or by number where they have none.
    Contact friction is the friction between a geom and the floor.
    """
    return differing(_quantities(before, after))


def _quantities(before: mujoco.MjModel, after: mujoco.MjModel) -> Iterator[tuple[str, float, float, str]]:
    for body in map(before.body, range(1, before.nbody)):
        yield f"mass of {_name(before, body)}", body.mass[0], _same(after.body, body).mass[0], "kg"
    has_floor = mujoco.mj_name2id(before, mujoco.mjtObj.mjOBJ_GEOM, "floor") >= 0
    for geom in map(before.geom, range(before.ngeom)):
        name, twin = geom.name or _name(before, before.body(geom.bodyid[0])), _same(after.geom, geom)
        if geom.type[0] == mujoco.mjtGeom.mjGEOM_CAPSULE:
            yield f"length of {name}", 2 * geom.size[1], 2 * twin.size[1], "m"
        if geom.type[0] != mujoco.mjtGeom.mjGEOM_PLANE:
            yield f"radius of {name}", geom.size[0], twin.size[0], "m"
            if has_floor:
                first, second = _friction(before, geom.id), _friction(after, twin.id)
                yield f"friction of {name} on floor", first, second, "1"
    for joint in map(before.joint, range(before.njnt)):
        twin = _same(after.joint, joint)
        for side, end in (("lower", 0), ("upper", 1)):
            first, second = (np.degrees(each.range[end]) for each in (joint, twin))
            yield f"{side} limit of {joint.name}", first, second, "deg"
        # Of a hinge; a sliding joint has N s/m and kg.
        yield f"damping of {joint.name}", joint.damping[0], twin.damping[0], "N m s/rad"
        yield f"armature of {joint.name}", joint.armature[0], twin.armature[0], "kg m²"
    for i in range(before.nu):
        name = before.joint(int(before.actuator_trnid[i][0])).name
        yield f"gear of {name}", before.actuator_gear[i][0], after.actuator_gear[i][0], "N m"
    yield "gravity", -before.opt.gravity[2], -after.opt.gravity[2], "m/s²"
    yield "height of the root", before.body_pos[1][2], after.body_pos[1][2], "m"


def _same(access: Callable[[str | int], Any], element: Any) -> Any:
    """Return the element of another model that corresponds to ``element``."""
    return access(element.name or int(element.id))


def _name(model: mujoco.MjModel, body: Any) -> str:
    """Return a body's name, or that of its first named geom, or its number."""
    geoms = [model.geom(i).name for i in range(model.ngeom) if model.geom_bodyid[i] == body.id]
    return next(filter(None, (body.name, *geoms)), f"body {body.id}")


def _friction(model: mujoco.MjModel, geom_id: int) -> float:
    """Return the sliding friction of the contact between a geom and the floor, by MuJoCo's rules."""
    geom, floor = model.geom(geom_id), model.geom("floor")
    for i in range(model.npair):
        if {int(model.pair_geom1[i]), int(model.pair_geom2[i])} == {geom.id, floor.id}:
            return float(model.pair_friction[i][0])
    return float(contact_parameter(geom, floor, "friction")[0])
