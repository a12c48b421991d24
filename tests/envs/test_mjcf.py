"""The 154 models, each compared with an independent computation on compiled and simulated quantities.

Expected values come from the stock Gymnasium model and textbook formulas; of the package only the id
and the MJCF text are used.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

from imujoco_minari.envs import mjcf
from imujoco_minari.envs.mjcf import canonical_mjcf, healthy_z_range
from imujoco_minari.variants import CATEGORIES, ROBOTS, Change, Variant, bases, catalogue, specification

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
MODELS = {"hopper": "hopper.xml", "halfcheetah": "half_cheetah.xml", "walker2d": "walker2d_v5.xml"}
FEET = {
    "hopper": ["foot_geom"],
    "halfcheetah": ["bfoot", "ffoot"],
    "walker2d": ["foot_geom", "foot_left_geom"],
}
HEALTHY = {"hopper": (0.7, np.inf), "walker2d": (0.8, 2.0)}

# What MuJoCo derives at compilation from the quantities that follow it.
DERIVED_FROM_INERTIA = {
    "body_invweight0", "body_subtreemass", "dof_invweight0", "dof_M0", "dof_Madr", "tendon_invweight0",
    "actuator_acc0", "stat.meaninertia", "stat.meanmass", "cam_poscom0", "light_poscom0",
}  # fmt: skip
DERIVED_FROM_GEOMETRY = {
    "stat.center", "stat.extent", "stat.meansize", "geom_rbound", "geom_aabb", "bvh_aabb", "body_contype",
    "cam_pos0", "cam_poscom0", "cam_mat0", "light_pos0", "light_poscom0", "light_dir0", "qpos_spring",
    "bvh_child", "bvh_depth", "bvh_nodeid", "dof_length",
}  # fmt: skip


def grammar(variant: Variant) -> tuple[str, str, float, str]:
    """Robot, category, factor and body, read off the id without the package's parser."""
    match = re.fullmatch(r"(\w+)-(mass|joint|length|friction)(inc|dec)_(\d+)_(\w+)", str(variant))
    assert match
    sign = 1 if match[3] == "inc" else -1
    return match[1], match[2], 1 + sign * int(match[4]) / 100, match[5]


@cache
def stock(robot: str) -> Any:
    return mujoco.MjModel.from_xml_path(str(ASSETS / MODELS[robot]))


def load(variant: Variant) -> Any:
    return mujoco.MjModel.from_xml_string(canonical_mjcf(variant))


def named(model: Any, kind: str, body: str) -> str:
    """The MJCF name that an id's body stands for."""
    count, access = {"geom": (model.ngeom, model.geom), "joint": (model.njnt, model.joint)}[kind]
    names = [access(i).name for i in range(count) if access(i).name.replace("_", "") == body]
    assert len(names) == 1, names
    return names[0]


def fields(model: Any) -> dict[str, Any]:
    found = {}
    for prefix, part in (("", model), ("opt.", model.opt), ("stat.", model.stat)):
        for name in dir(part):
            if name.startswith("_"):
                continue
            value = getattr(part, name)
            if isinstance(value, np.ndarray | int | float) and not isinstance(value, bool):
                found[prefix + name] = np.asarray(value)
    # Counts of bytes and of characters in the file say nothing of physics.
    return {
        n: v
        for n, v in found.items()
        if n not in ("buffer", "nbuffer", "narena", "signature", "names", "npaths", "paths")
    }


def changed_fields(before: Any, after: Any) -> set[str]:
    ours, theirs = fields(before), fields(after)
    return {
        name
        for name in ours
        if not np.array_equal(ours[name], theirs[name], equal_nan=ours[name].dtype.kind == "f")
    }


def of(category: str) -> Any:
    return pytest.mark.parametrize("variant", catalogue(category=category), ids=str)


@pytest.mark.parametrize("variant", bases(), ids=str)
def test_a_base_is_the_stock_model_to_the_bit(variant: Variant) -> None:
    assert changed_fields(stock(variant.robot), load(variant)) == set()


@of("mass")
def test_mass_scales_one_body_and_its_inertia(variant: Variant) -> None:
    robot, _, factor, name = grammar(variant)
    before, after = stock(robot), load(variant)
    body = before.geom(named(before, "geom", name)).bodyid[0]
    assert after.body_mass[body] == pytest.approx(before.body_mass[body] * factor, rel=1e-12)
    assert after.body_inertia[body] == pytest.approx(before.body_inertia[body] * factor, rel=1e-12)
    others = np.arange(before.nbody) != body
    assert np.array_equal(after.body_mass[others], before.body_mass[others])
    assert np.array_equal(after.body_inertia[others], before.body_inertia[others])
    assert changed_fields(before, after) <= {"body_mass", "body_inertia"} | DERIVED_FROM_INERTIA


@of("joint")
def test_joint_shrinks_one_range_and_keeps_the_rest_pose_in_it(variant: Variant) -> None:
    robot, _, factor, name = grammar(variant)
    before, after = stock(robot), load(variant)
    joint = before.joint(named(before, "joint", name)).id
    assert after.jnt_range[joint] == pytest.approx(before.jnt_range[joint] * factor, rel=1e-12)
    assert np.ptp(after.jnt_range[joint]) == pytest.approx(
        np.ptp(before.jnt_range[joint]) * factor, rel=1e-12
    )
    others = np.arange(before.njnt) != joint
    assert np.array_equal(after.jnt_range[others], before.jnt_range[others])
    low, high = after.jnt_range[joint]
    assert low <= after.qpos0[after.jnt_qposadr[joint]] <= high
    assert changed_fields(before, after) == {"jnt_range"}


def rest(model: Any) -> Any:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data


def segment(model: Any, data: Any, name: str) -> Any:
    """The two ends of a capsule's axis in the world, of shape (2, 3)."""
    geom = model.geom(name).id
    axis = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
    return np.array([data.geom_xpos[geom] - axis, data.geom_xpos[geom] + axis])


def capsules(model: Any) -> list[str]:
    return [
        model.geom(i).name for i in range(model.ngeom) if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_CAPSULE
    ]


def bottom(model: Any) -> float:
    data = rest(model)
    return min(float(segment(model, data, n)[:, 2].min() - model.geom(n).size[0]) for n in capsules(model))


def capsule_volume_and_moments(radius: float, length: float) -> tuple[float, float, float]:
    """Volume, and moments of inertia a unit of density, across and along the axis, of a solid capsule.

    A cylinder and two half balls; each half ball's centre of mass lies 3/8 of the radius past its rim.
    """
    cylinder, ball = np.pi * radius**2 * length, 4 / 3 * np.pi * radius**3
    across = cylinder * (length**2 / 12 + radius**2 / 4)
    about_own_centre = ball * radius**2 * (2 / 5 - (3 / 8) ** 2)
    across += about_own_centre + ball * (length / 2 + 3 / 8 * radius) ** 2
    along = cylinder * radius**2 / 2 + ball * radius**2 * 2 / 5
    return cylinder + ball, across, along


def nearest(point: Any, ends: Any) -> Any:
    """The point of the segment between ``ends`` nearest to ``point``."""
    along = ends[1] - ends[0]
    share = np.clip((point - ends[0]) @ along / (along @ along), 0, 1)
    return ends[0] + share * along


@of("length")
def test_length_stretches_one_limb_at_constant_density(variant: Variant) -> None:
    robot, _, factor, body_name = grammar(variant)
    before, after = stock(robot), load(variant)
    name = named(before, "geom", body_name)
    length, radius = 2 * before.geom(name).size[1], before.geom(name).size[0]
    assert 2 * after.geom(name).size[1] == pytest.approx(length * factor, rel=1e-12)
    assert after.geom(name).size[0] == radius
    volume, _, _ = capsule_volume_and_moments(radius, length)
    new_volume, across, along = capsule_volume_and_moments(radius, length * factor)
    body = before.geom(name).bodyid[0]
    density = before.body_mass[body] / volume
    assert after.body_mass[body] == pytest.approx(density * new_volume, rel=1e-9)
    assert sorted(after.body_inertia[body]) == pytest.approx(
        sorted(density * np.array([along, across, across])), rel=1e-9
    )
    others = np.arange(before.nbody) != body
    assert np.array_equal(after.body_mass[others], before.body_mass[others])
    assert np.array_equal(after.body_inertia[others], before.body_inertia[others])
    allowed = {
        "body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "geom_size", "geom_pos",
        "qpos0", "jnt_pos", "body_sameframe", "geom_sameframe", "body_simple",
    }  # fmt: skip
    assert changed_fields(before, after) <= allowed | DERIVED_FROM_INERTIA | DERIVED_FROM_GEOMETRY


@of("length")
def test_length_keeps_the_limbs_joined(variant: Variant) -> None:
    robot, _, _, body_name = grammar(variant)
    before, after = stock(robot), load(variant)
    name = named(before, "geom", body_name)
    at_rest, stretched = rest(before), rest(after)
    limb, new_limb = segment(before, at_rest, name), segment(after, stretched, name)
    body = before.geom(name).bodyid[0]

    def anchor(model: Any, data: Any, index: int) -> Any:
        return data.xpos[index] + data.xmat[index].reshape(3, 3) @ model.jnt_pos[model.body_jntadr[index]]

    children = [i for i in range(before.nbody) if before.body_parentid[i] == body]
    for child in children:
        joint, new_joint = anchor(before, at_rest, child), anchor(after, stretched, child)
        end = int(np.argmin(np.linalg.norm(limb - joint, axis=1)))
        assert new_joint - new_limb[end] == pytest.approx(joint - limb[end], abs=1e-12)
    if before.body_parentid[body] != 0:
        joint, new_joint = anchor(before, at_rest, body), anchor(after, stretched, body)
        gap, new_gap = nearest(joint, limb) - joint, nearest(new_joint, new_limb) - new_joint
        assert new_gap == pytest.approx(gap, abs=1e-12)
    else:
        middle = new_limb.mean(axis=0) - stretched.xpos[body]
        assert middle == pytest.approx(limb.mean(axis=0) - at_rest.xpos[body], abs=1e-12)
    # Every other limb is as it was within its own body.
    for other in set(capsules(before)) - {name}:
        own = before.geom(other).bodyid[0]
        assert segment(after, stretched, other) - stretched.xpos[own] == pytest.approx(
            segment(before, at_rest, other) - at_rest.xpos[own], abs=1e-12
        )


@of("length")
def test_length_keeps_the_clearance_and_moves_the_healthy_heights(variant: Variant) -> None:
    robot, *_ = grammar(variant)
    before, after = stock(robot), load(variant)
    assert bottom(after) == pytest.approx(bottom(before), abs=1e-12)
    raised = after.body_pos[1][2] - before.body_pos[1][2]
    if robot == "halfcheetah":
        assert healthy_z_range(variant) is None
        assert np.array_equal(after.qpos0, before.qpos0)
        return
    low, high = HEALTHY[robot]
    assert healthy_z_range(variant) == pytest.approx((low + raised, high + raised))
    # The height that the robot observes is still its torso's height above the floor.
    for model in (before, after):
        assert model.qpos0[1] == pytest.approx(rest(model).xpos[1][2], abs=1e-12)


def contacts(model: Any, seed: int, steps: int = 400) -> dict[frozenset[str], Any]:
    """Contacts met in a simulation under random controls: geoms -> (friction, condim, solref, solimp)."""
    data, rng, met = mujoco.MjData(model), np.random.default_rng(seed), {}
    for step in range(steps):
        if step % 100 == 0:
            mujoco.mj_resetData(model, data)
        data.ctrl[:] = rng.uniform(-1, 1, model.nu)
        mujoco.mj_step(model, data, nstep=4)
        for contact in data.contact:
            geoms = frozenset(model.geom(i).name for i in (contact.geom1, contact.geom2))
            met[geoms] = (
                contact.friction.copy(),
                contact.dim,
                contact.solref.copy(),
                contact.solimp.copy(),
                contact.includemargin,
            )
    return met


@of("friction")
def test_friction_of_simulated_foot_floor_contacts_scales(variant: Variant) -> None:
    robot, _, factor, body = grammar(variant)
    assert body == "feet"
    base, ours = contacts(stock(robot), 0), contacts(load(variant), 0)
    feet = {frozenset({foot, "floor"}) for foot in FEET[robot]}
    assert feet <= set(ours)
    assert feet <= set(base)
    for geoms in set(ours) & set(base):
        friction, *solver = base[geoms]
        expected = friction * [factor, factor, 1, 1, 1] if geoms in feet else friction
        assert ours[geoms][0] == pytest.approx(expected, rel=1e-12), geoms
        for mine, theirs in zip(ours[geoms][1:], solver, strict=True):
            assert np.array_equal(mine, theirs), geoms


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("category", CATEGORIES)
def test_a_change_of_nothing_is_the_stock_environment_step_for_step(robot: str, category: str) -> None:
    from imujoco_minari.envs.registration import make

    ids = {"hopper": "Hopper-v5", "halfcheetah": "HalfCheetah-v5", "walker2d": "Walker2d-v5"}
    for body in specification(robot).categories[category].bodies:
        theirs = gymnasium.make(ids[robot], disable_env_checker=True)
        ours = make(Variant(robot, (Change(category, 0, body),)), disable_env_checker=True)
        rng = np.random.default_rng(1)
        for seed in range(3):
            assert np.array_equal(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0])
            for _ in range(100):
                action = rng.uniform(-1, 1, ours.action_space.shape).astype(np.float32)
                mine, stocks = ours.step(action), theirs.step(action)
                assert np.array_equal(mine[0], stocks[0])
                assert mine[1:4] == stocks[1:4]
                assert mine[4] == stocks[4]
                if mine[2] or mine[3]:
                    break


@pytest.mark.parametrize("variant", catalogue(), ids=str)
def test_the_text_is_stable_and_loads_without_a_warning(
    variant: Variant, capfd: pytest.CaptureFixture[str]
) -> None:
    first = canonical_mjcf(variant)
    for cached in (canonical_mjcf, mjcf._edited, mjcf._bake_once):
        cached.cache_clear()
    assert canonical_mjcf(variant) == first
    model = load(variant)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=50)
    assert np.isfinite(data.qpos).all()
    assert capfd.readouterr().err == ""
