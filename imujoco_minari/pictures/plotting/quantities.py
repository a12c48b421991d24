"""Labels of the columns of observations and actions: names and units, read from the model."""

from __future__ import annotations

import mujoco

from imujoco_minari.envs.mjcf import canonical_mjcf, compile_mjcf
from imujoco_minari.variants import Variant


def observation_labels(robot: str) -> list[str]:
    """Return the labels of an observation: positions without the travelled distance, then velocities."""
    model = compile_mjcf(canonical_mjcf(Variant(robot)))
    positions, velocities = [], []
    for number, kind in enumerate(model.jnt_type):
        what, unit = ("angle", "rad") if kind == mujoco.mjtJoint.mjJNT_HINGE else ("position", "m")
        name = model.joint(number).name
        positions.append(f"{what} of {name} ({unit})")
        velocities.append(f"velocity of {name} ({unit}/s)")
    return positions[1:] + velocities


def action_labels(robot: str) -> list[str]:
    """Return the labels of an action: torques as shares of the motor's gear."""
    model = compile_mjcf(canonical_mjcf(Variant(robot)))
    joints = [model.joint(number).name for number, _ in model.actuator_trnid]
    gears = [gear for gear, *_ in model.actuator_gear]
    return [f"action on {name} (1 = {gear:g} N m)" for name, gear in zip(joints, gears, strict=True)]
