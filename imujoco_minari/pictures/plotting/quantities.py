"""Names and units of the columns of observations and actions, read from the model."""

from __future__ import annotations

from typing import NamedTuple

import mujoco

from imujoco_minari.envs.mjcf import canonical_mjcf, compile_mjcf
from imujoco_minari.variants import Variant


class Quantity(NamedTuple):
    """The name and the unit of a column."""

    name: str
    unit: str

    def __str__(self) -> str:
        return f"{self.name} ({self.unit})"


def observation_quantities(robot: str) -> list[Quantity]:
    """Return the columns of an observation: positions without the travelled distance, then velocities."""
    model = compile_mjcf(canonical_mjcf(Variant(robot)))
    positions, velocities = [], []
    for number, kind in enumerate(model.jnt_type):
        what, unit = ("angle", "rad") if kind == mujoco.mjtJoint.mjJNT_HINGE else ("position", "m")
        name = model.joint(number).name
        positions.append(Quantity(f"{what} of {name}", unit))
        velocities.append(Quantity(f"velocity of {name}", f"{unit}/s"))
    return positions[1:] + velocities


def action_quantities(robot: str) -> list[Quantity]:
    """Return the columns of an action: torques as shares of the motor's gear."""
    model = compile_mjcf(canonical_mjcf(Variant(robot)))
    return [
        Quantity(
            f"action on {model.joint(model.actuator_trnid[i][0]).name}",
            f"1 = {model.actuator_gear[i][0]:g} N m",
        )
        for i in range(model.nu)
    ]
