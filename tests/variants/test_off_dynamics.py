"""ODRL's tasks: their targets have the quantities that ODRL's files state, in the simulated model."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from imujoco_minari.envs.mjcf import canonical_mjcf
from imujoco_minari.errors import VariantError
from imujoco_minari.variants.off_dynamics import off_dynamics, off_dynamics_names


def target_model(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(canonical_mjcf(off_dynamics(name).target))


def contact_friction(name: str) -> float:
    """Drop the robot and return the sliding friction of a foot's first contact with the floor."""
    model = target_model(name)
    data = mujoco.MjData(model)
    floor = model.geom("floor").id
    for _ in range(2000):
        mujoco.mj_step(model, data)
        for contact in data.contact:
            if floor in contact.geom and ("foot" in model.geom(max(contact.geom)).name):
                return float(contact.friction[0])
    raise AssertionError("the foot never touched the floor")


def test_the_tasks_are_those_of_four_robots() -> None:
    counts = {robot: len(off_dynamics_names(robot)) for robot in ("ant", "halfcheetah", "hopper", "walker2d")}
    # Friction and gravity have 4 levels, each kinematic and morphology task has 3.
    assert counts == {"ant": 17, "halfcheetah": 14, "hopper": 20, "walker2d": 20}
    assert len(off_dynamics_names()) == sum(counts.values())


@pytest.mark.parametrize("name", off_dynamics_names())
def test_every_target_compiles_and_moves(name: str) -> None:
    task = off_dynamics(name)
    assert str(task.source) == f"{task.target.robot}-base"
    model = target_model(name)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=20)
    assert np.isfinite(data.qpos).all()


def test_a_simulated_contact_of_hoppers_foot_has_the_scaled_friction() -> None:
    levels = {"0.1": 0.2, "0.5": 1.0, "2.0": 4.0, "5.0": 10.0}
    for level, friction in levels.items():
        assert contact_friction(f"hopper-friction-{level}") == pytest.approx(friction, rel=1e-12)
    assert "1.0 in both" in off_dynamics("hopper-friction-0.1").note


@pytest.mark.parametrize("robot", ["ant", "halfcheetah", "hopper", "walker2d"])
def test_gravity_is_scaled(robot: str) -> None:
    for level, gravity in {"0.1": -0.981, "0.5": -4.905, "2.0": -19.62, "5.0": -49.05}.items():
        assert target_model(f"{robot}-gravity-{level}").opt.gravity == pytest.approx([0, 0, gravity])


def degrees(joint: str) -> Callable[[mujoco.MjModel], np.ndarray]:
    return lambda model: np.degrees(model.joint(joint).range)


def capsule(geom: str) -> Callable[[mujoco.MjModel], np.ndarray]:
    return lambda model: model.geom(geom).size[:2]


# Limits in degrees; radius and half length in metres, as in ODRL's files.
STATED = [
    ("hopper-kinematic-legjnt-hard", degrees("leg_joint"), (-30, 0)),
    ("hopper-kinematic-footjnt-easy", degrees("foot_joint"), (-36, 36)),
    ("hopper-morph-foot-medium", capsule("foot_geom"), (0.036, 0.117)),
    ("hopper-morph-torso-hard", capsule("torso_geom"), (0.125, 0.4)),
    ("walker2d-kinematic-footjnt-hard", degrees("foot_left_joint"), (-9, 9)),
    ("walker2d-kinematic-thighjnt-medium", degrees("thigh_joint"), (-75, 0)),
    ("walker2d-morph-leg-hard", capsule("thigh_left_geom"), (0.05, 0.425)),
    ("walker2d-morph-leg-hard", capsule("leg_geom"), (0.04, 0.05)),
    ("halfcheetah-kinematic-thighjnt-easy", lambda m: m.joint("bthigh").range, (-0.416, 0.84)),
    ("halfcheetah-kinematic-footjnt-medium", lambda m: m.joint("ffoot").range, (-0.25, 0.25)),
    ("ant-kinematic-hipjnt-hard", degrees("hip_3"), (-6, 6)),
    ("ant-morph-halflegs-hard", capsule("right_ankle_geom"), (0.08, 0.04 * 2**0.5)),
    ("ant-morph-halflegs-hard", capsule("third_ankle_geom"), (0.08, 0.2 * 2**0.5)),
    ("ant-morph-alllegs-easy", capsule("third_ankle_geom"), (0.08, 0.16 * 2**0.5)),
]


@pytest.mark.parametrize(("name", "measure", "stated"), STATED)
def test_a_target_has_the_stated_shape_or_range(
    name: str, measure: Callable[[mujoco.MjModel], np.ndarray], stated: tuple[float, float]
) -> None:
    # A percent has two decimals, so a thigh of 0.45 m has the stated length to a tenth of a millimetre.
    assert measure(target_model(name)) == pytest.approx(stated, abs=5e-5 if "morph-leg" in name else 1e-9)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("hopper-friction-0.2", r"unknown task 'hopper-friction-0.2' \(did you mean"),
        ("humanoid-friction-0.1", "unknown task"),
        ("ant-kinematic-anklejnt-easy", "is no variant: its files keep the end of the range"),
        ("halfcheetah-morph-torso-hard", "is no variant: the torso has two geoms"),
    ],
)
def test_other_names_are_refused(name: str, message: str) -> None:
    with pytest.raises(VariantError, match=message):
        off_dynamics(name)
    with pytest.raises(VariantError, match="no task of the robot 'humanoid'"):
        off_dynamics_names("humanoid")
