"""The physical quantities that a variant changes, from its compiled model and that of its base robot."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

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
    found = model_differences(
        compile_mjcf(canonical_mjcf(variant.base)), compile_mjcf(canonical_mjcf(variant))
    )
    before, after = healthy_z_range(variant.base), healthy_z_range(variant)
    if before is not None and after is not None and before != after:
        found += [
            Difference(f"{side} healthy height", first, second, "m")
            for side, first, second in zip(("lowest", "highest"), before, after, strict=True)
            if first != second
        ]
    return found


def model_differences(before: mujoco.MjModel, after: mujoco.MjModel) -> list[Difference]:
    """Return the quantities in which two compiled models of one robot differ.

    Geoms and joints are matched by name. Contact friction is the friction between a geom and the floor.
    """
    pairs: list[Difference] = []

    def compare(quantity: str, first: float, second: float, unit: str) -> None:
        if not np.isclose(first, second, rtol=1e-9, atol=1e-12):
            pairs.append(Difference(quantity, float(first), float(second), unit))

    for i in range(1, before.nbody):
        name = before.body(i).name
        compare(f"mass of {name}", before.body(name).mass[0], after.body(name).mass[0], "kg")
    for i in range(before.ngeom):
        name = before.geom(i).name
        if before.geom_type[i] == mujoco.mjtGeom.mjGEOM_CAPSULE:
            compare(f"length of {name}", 2 * before.geom(name).size[1], 2 * after.geom(name).size[1], "m")
            compare(f"radius of {name}", before.geom(name).size[0], after.geom(name).size[0], "m")
            compare(f"friction of {name} on floor", _friction(before, name), _friction(after, name), "1")
    for i in range(before.njnt):
        name = before.joint(i).name
        for side, end in (("lower", 0), ("upper", 1)):
            first, second = (np.degrees(model.joint(name).range[end]) for model in (before, after))
            compare(f"{side} limit of {name}", first, second, "deg")
    compare("height of the root", before.body_pos[1][2], after.body_pos[1][2], "m")
    return pairs


def _friction(model: mujoco.MjModel, name: str) -> float:
    """Return the sliding friction of the contact between a geom and the floor, by MuJoCo's rules."""
    geom, floor = model.geom(name), model.geom("floor")
    for i in range(model.npair):
        if {int(model.pair_geom1[i]), int(model.pair_geom2[i])} == {geom.id, floor.id}:
            return float(model.pair_friction[i][0])
    if geom.priority[0] != floor.priority[0]:
        return float(max((geom, floor), key=lambda g: g.priority[0]).friction[0])
    return float(max(geom.friction[0], floor.friction[0]))
