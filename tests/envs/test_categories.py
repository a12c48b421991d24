"""The laws of the categories, over every body of every page, on compiled and simulated quantities.

Expected values come from the stock Gymnasium model, the id and textbook formulas. Of the package, only the
MJCF text, the names behind a group, and the fields that a later category promises to change are used.
"""

from __future__ import annotations

import re
from copy import copy
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

from imujoco_minari.envs.categories import BY_NAME
from imujoco_minari.envs.mjcf import canonical_mjcf, healthy_z_range
from imujoco_minari.variants import (
    CATEGORIES,
    ROBOTS,
    Change,
    Variant,
    catalogue,
    known_robots,
    specification,
)

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
FILES = {"halfcheetah": "half_cheetah.xml", "walker2d": "walker2d_v5.xml"}
FEET = {
    "hopper": ["foot_geom"],
    "halfcheetah": ["bfoot", "ffoot"],
    "walker2d": ["foot_geom", "foot_left_geom"],
}

# The fields of a compiled model that the first categories change, whatever the package says.
FIELDS = {
    "mass": {"body_mass", "body_inertia"},
    "joint": {"jnt_range"},
    "length": {
        "body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "geom_size", "geom_pos",
        "qpos0", "jnt_pos", "body_sameframe", "geom_sameframe", "body_simple",
    },
    "friction": set(),
}  # fmt: skip
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


def every(category: str) -> list[Variant]:
    """The 154 listed variants, and a variant of every other body and group of the pages.

    Each robot has a decrease and an increase, if the category has increases.
    """
    variants: list[Variant] = []
    for robot in known_robots():
        listing = specification(robot).categories.get(category)
        if listing is None:
            continue
        changes = [variant.changes[0] for variant in catalogue(robot, category) if robot in ROBOTS]
        listed = {change.body for change in changes}
        for place, body in enumerate((*listing.bodies, *listing.groups)):
            widens = category != "joint" or set(listing.names(body)) <= set(listing.widen)
            percents = (-37.5, 50) if widens else (-37.5,)
            seen = {change.percent > 0 for change in changes}
            chosen = [percent for percent in percents if (percent > 0) not in seen]
            if not chosen and body not in listed:
                chosen = [percents[place % len(percents)]]
            changes += [Change(category, percent, body) for percent in chosen]
        variants += [Variant(robot, (change,)) for change in changes]
    return variants


def of(category: str) -> Any:
    return pytest.mark.parametrize("variant", every(category), ids=str)


def grammar(variant: Variant) -> tuple[str, float, str]:
    """Category, factor and body, read off the id without the package's parser."""
    match = re.fullmatch(r"[a-z0-9]+-([a-z]+)(inc|dec)_([0-9p]+)_([a-z0-9]+)", str(variant))
    assert match
    percent = float(match[3].replace("p", "."))
    return match[1], 1 + (percent if match[2] == "inc" else -percent) / 100, match[4]


def mjcf_names(variant: Variant) -> list[str]:
    """The MJCF names that an id's body stands for."""
    category, _, body = grammar(variant)
    names = list(variant.mjcf_names)
    if body == "feet":
        assert names == FEET.get(variant.robot, names)
    elif body not in specification(variant.robot).categories[category].groups:
        assert [name.replace("_", "") for name in names] == [body]
    return names


@cache
def stock(robot: str) -> Any:
    """Gymnasium's own model, the same object for every test: none changes it."""
    return mujoco.MjModel.from_xml_path(str(ASSETS / FILES.get(robot, f"{robot}.xml")))


def load(variant: Variant) -> Any:
    return mujoco.MjModel.from_xml_string(canonical_mjcf(variant))


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


def rest(model: Any) -> Any:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data


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


def compared(variant: Variant) -> tuple[Any, Any, float, list[str]]:
    """The stock model, ours, the factor, and the MJCF names, after a check of what else has changed."""
    category, factor, _ = grammar(variant)
    before, after = stock(variant.robot), load(variant)
    law = BY_NAME[category]
    derived = DERIVED_FROM_INERTIA | (DERIVED_FROM_GEOMETRY | {"key_qpos"} if law.moves_limbs else set())
    found = changed_fields(before, after)
    if category == "friction":
        # The pair, its place in the file's names, and nothing else.
        found = {name for name in found if "pair" not in name and "name" not in name}
    assert found <= FIELDS.get(category, law.fields) | derived
    return before, after, factor, mjcf_names(variant)


def limb(model: Any, name: str) -> int:
    """The body of a geom, or of that name."""
    geoms = [i for i in range(model.ngeom) if model.geom(i).name == name]
    return int(model.geom_bodyid[geoms[0]]) if geoms else int(model.body(name).id)


@of("mass")
def test_mass_scales_bodies_and_their_inertia(variant: Variant) -> None:
    before, after, factor, names = compared(variant)
    factors = np.ones(before.nbody)
    factors[[limb(before, name) for name in names]] = factor
    np.testing.assert_allclose(after.body_mass, before.body_mass * factors, rtol=1e-12)
    np.testing.assert_allclose(after.body_inertia, before.body_inertia * factors[:, None], rtol=1e-12)
    others = factors == 1
    assert np.array_equal(after.body_mass[others], before.body_mass[others])
    assert np.array_equal(after.body_inertia[others], before.body_inertia[others])
    # The same force gives a lone body less acceleration: the whole weight is the sum.
    assert after.body_subtreemass[0] == pytest.approx(float(before.body_mass @ factors), rel=1e-12)


@of("joint")
def test_joint_scales_ranges(variant: Variant) -> None:
    before, after, factor, names = compared(variant)
    factors = np.ones(before.njnt)
    factors[[before.joint(name).id for name in names]] = factor
    np.testing.assert_allclose(after.jnt_range, before.jnt_range * factors[:, None], rtol=1e-12)
    assert np.array_equal(after.jnt_range[factors == 1], before.jnt_range[factors == 1])
    assert np.array_equal(rests_in_range(after), rests_in_range(before))
    assert changed_fields(before, after) == {"jnt_range"}


def rests_in_range(model: Any) -> Any:
    rest_pose = model.qpos0[model.jnt_qposadr]
    return (model.jnt_range[:, 0] <= rest_pose) & (rest_pose <= model.jnt_range[:, 1])


@of("gear")
def test_gear_scales_the_torque_of_motors(variant: Variant) -> None:
    before, after, factor, names = compared(variant)
    torques = []
    for model in (before, after):
        data = mujoco.MjData(model)
        data.ctrl[:] = model.actuator_ctrlrange[:, 1]
        mujoco.mj_forward(model, data)
        torques.append(data.qfrc_actuator.copy())
    factors = np.ones(before.nv)
    factors[[before.joint(name).dofadr[0] for name in names]] = factor
    assert np.all(torques[0][factors != 1] != 0)
    np.testing.assert_allclose(torques[1], torques[0] * factors, rtol=1e-12)
    np.testing.assert_array_equal(after.actuator_ctrlrange, before.actuator_ctrlrange)


@of("damping")
def test_damping_scales_the_torque_against_velocity(variant: Variant) -> None:
    before, after, factor, names = compared(variant)
    torques = []
    for model in (before, after):
        data = mujoco.MjData(model)
        data.qvel[:] = np.linspace(1, 2, model.nv)
        mujoco.mj_forward(model, data)
        torques.append(data.qfrc_damper.copy())
    factors = np.ones(before.nv)
    factors[[before.joint(name).dofadr[0] for name in names]] = factor
    assert np.all(torques[0][factors != 1] < 0)
    np.testing.assert_allclose(torques[1], torques[0] * factors, rtol=1e-12)


@of("armature")
def test_armature_adds_inertia_to_joints(variant: Variant) -> None:
    before, after, factor, names = compared(variant)
    matrices = []
    for model in (before, after):
        data, matrix = mujoco.MjData(model), np.empty((model.nv, model.nv))
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, matrix)
        matrices.append(matrix)
    added = np.zeros(before.nv)
    for name in names:
        joint = before.joint(name)
        assert joint.armature[0] > 0
        added[joint.dofadr[0]] = (factor - 1) * joint.armature[0]
    np.testing.assert_allclose(matrices[1] - matrices[0], np.diag(added), atol=1e-9)


@of("gravity")
def test_gravity_scales_the_acceleration_of_the_fall(variant: Variant) -> None:
    before, after, factor, names = compared(variant)
    assert names == ["world"]
    falls = []
    for model in (copy(before), copy(after)):
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        start = data.subtree_com[0].copy()
        for _ in range(10):
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        falls.append(data.subtree_com[0] - start)
        time = data.time
    assert falls[0][2] < 0
    # A free fall; the joints' springs and limits are internal forces.
    np.testing.assert_allclose(falls[1][2], factor * falls[0][2], rtol=0.02)
    assert falls[1][2] == pytest.approx(-9.81 * factor * time**2 / 2, rel=0.15)
    assert after.opt.gravity == pytest.approx(before.opt.gravity * factor, rel=1e-12)


def ends(model: Any, data: Any, geom: int) -> Any:
    axis = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
    return np.array([data.geom_xpos[geom] - axis, data.geom_xpos[geom] + axis])


def round_parts(model: Any) -> list[int]:
    kinds = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_SPHERE))
    return [i for i in range(model.ngeom) if int(model.geom_type[i]) in kinds]


def bottom(model: Any) -> float:
    data, lowest = rest(model), np.inf
    for geom in round_parts(model):
        sphere = int(model.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_SPHERE)
        points = data.geom_xpos[[geom]] if sphere else ends(model, data, geom)
        lowest = min(lowest, float(points[:, 2].min() - model.geom_size[geom, 0]))
    return lowest


def anchor(model: Any, data: Any, body: int) -> Any:
    """Where a body is attached to its parent: at its first joint, or at its origin."""
    if model.body_jntnum[body] == 0:
        return data.xpos[body].copy()
    return data.xpos[body] + data.xmat[body].reshape(3, 3) @ model.jnt_pos[model.body_jntadr[body]]


@pytest.mark.parametrize("variant", [*every("length"), *every("size")], ids=str)
def test_a_capsule_changes_at_constant_density_and_stays_joined(variant: Variant) -> None:
    before, after, factor, names = compared(variant)
    bodies = [limb(before, name) for name in names]
    length, thickness = (factor, 1.0) if grammar(variant)[0] == "length" else (1.0, factor)
    at_rest, changed = rest(before), rest(after)
    for body in range(1, before.nbody):
        if body not in bodies:
            assert after.body_mass[body] == before.body_mass[body]
            assert np.array_equal(after.body_inertia[body], before.body_inertia[body])
            # Every other limb is as it was within its own body.
            for geom in round_parts(before):
                if before.geom_bodyid[geom] == body:
                    own, new_own = ends(before, at_rest, geom), ends(after, changed, geom)
                    offset = at_rest.xpos[body] - changed.xpos[body]
                    assert new_own + offset == pytest.approx(own, abs=1e-12)
            continue
        geom = int(before.body_geomadr[body])
        radius, size = before.geom_size[geom][0], 2 * before.geom_size[geom][1]
        assert after.geom_size[geom][0] == radius or thickness != 1
        assert after.geom_size[geom][0] == pytest.approx(radius * thickness, rel=1e-12)
        assert 2 * after.geom_size[geom][1] == pytest.approx(size * length, rel=1e-12)
        volume, *_ = capsule_volume_and_moments(radius, size)
        density = before.body_mass[body] / volume
        new_volume, across, along = capsule_volume_and_moments(radius * thickness, size * length)
        assert after.body_mass[body] == pytest.approx(density * new_volume, rel=1e-9)
        moments = sorted(density * np.array([along, across, across]))
        assert sorted(after.body_inertia[body]) == pytest.approx(moments, rel=1e-9)
        limb_before, limb_after = ends(before, at_rest, geom), ends(after, changed, geom)
        for child in np.flatnonzero(before.body_parentid == body):
            joint, new_joint = anchor(before, at_rest, child), anchor(after, changed, child)
            end = int(np.argmin(np.linalg.norm(limb_before - joint, axis=1)))
            assert new_joint - limb_after[end] == pytest.approx(joint - limb_before[end], abs=1e-12)
        if before.body_parentid[body] != 0 and before.body_jntnum[body]:
            joint, new_joint = anchor(before, at_rest, body), anchor(after, changed, body)
            gap, new_gap = nearest(joint, limb_before) - joint, nearest(new_joint, limb_after) - new_joint
            assert new_gap == pytest.approx(gap, abs=1e-12)
        elif before.body_parentid[body] == 0:
            middle = limb_after.mean(axis=0) - changed.xpos[body]
            assert middle == pytest.approx(limb_before.mean(axis=0) - at_rest.xpos[body], abs=1e-12)
    assert bottom(after) == pytest.approx(bottom(before), abs=1e-12)
    raised = after.body_pos[1][2] - before.body_pos[1][2]
    heights, base = healthy_z_range(variant), specification(variant.robot).healthy_z_range
    if base is None:
        assert heights is None
        assert np.array_equal(after.qpos0, before.qpos0)
    else:
        assert heights == pytest.approx((base[0] + raised, base[1] + raised))
        # The height that the robot observes is still its torso's height above the floor.
        place = 2 if before.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE else 1
        for model, data in ((before, at_rest), (after, changed)):
            assert model.qpos0[place] == pytest.approx(data.xpos[1][2], abs=1e-12)


@of("friction")
def test_friction_of_simulated_contacts_of_feet_and_floor_scales(variant: Variant) -> None:
    _, after, factor, names = compared(variant)
    base, ours = stock_contacts(variant.robot), contacts(after)
    feet = {frozenset({name, "floor"}) for name in names}
    assert feet <= set(base) & set(ours)
    for geoms in set(base) & set(ours):
        friction, *solver = base[geoms]
        expected = friction * [factor, factor, 1, 1, 1] if geoms in feet else friction
        assert ours[geoms][0] == pytest.approx(expected, rel=1e-12), geoms
        for mine, theirs in zip(ours[geoms][1:], solver, strict=True):
            assert np.array_equal(mine, theirs), geoms


def contacts(model: Any) -> dict[frozenset[str], Any]:
    """Contacts met in a fall under random controls."""
    data, rng, met = mujoco.MjData(model), np.random.default_rng(0), {}
    for step in range(800):
        if step % 200 == 0:
            mujoco.mj_resetData(model, data)
        data.ctrl[:] = rng.uniform(-1, 1, model.nu) * model.actuator_ctrlrange[:, 1]
        mujoco.mj_step(model, data, nstep=4)
        for found in data.contact:
            geoms = frozenset(model.geom(i).name for i in (found.geom1, found.geom2))
            solver = (found.dim, found.solref.copy(), found.solimp.copy(), found.includemargin)
            met[geoms] = (found.friction.copy(), *solver)
    return met


@cache
def stock_contacts(robot: str) -> dict[frozenset[str], Any]:
    return contacts(stock(robot))


@pytest.mark.parametrize("robot", known_robots())
def test_a_change_of_nothing_is_the_stock_model_to_the_bit(robot: str) -> None:
    before = stock(robot)
    assert changed_fields(before, load(Variant(robot))) == set()
    for category, listing in specification(robot).categories.items():
        for body in (*listing.bodies, *listing.groups):
            after = load(Variant(robot, (Change(category, 0, body),)))
            found = changed_fields(before, after)
            if category == "friction":
                found = {name for name in found if "pair" not in name and "name" not in name}
                assert np.array_equal(fall(before), fall(after))
            assert found == set(), (category, body)


def fall(model: Any) -> Any:
    """The positions along a fall under random controls, of shape (steps, nq)."""
    data, rng, positions = mujoco.MjData(model), np.random.default_rng(0), []
    for _ in range(600):
        data.ctrl[:] = rng.uniform(-1, 1, model.nu) * model.actuator_ctrlrange[:, 1]
        mujoco.mj_step(model, data)
        positions.append(data.qpos.copy())
    return np.array(positions)


def test_every_category_is_of_some_page_and_has_its_laws() -> None:
    assert all(any(c in specification(robot).categories for robot in known_robots()) for c in CATEGORIES)
    tested = [variant for category in CATEGORIES for variant in every(category)]
    assert set(catalogue()) <= set(tested)
    assert len(set(tested)) == len(tested)
    directions: dict[tuple[str, str], set[bool]] = {}
    bodies: dict[tuple[str, str], set[str]] = {}
    for variant in tested:
        (change,) = variant.changes
        directions.setdefault((variant.robot, change.category), set()).add(change.percent > 0)
        bodies.setdefault((variant.robot, change.category), set()).add(change.body)
    for (robot, category), found in directions.items():
        listing = specification(robot).categories[category]
        assert bodies[robot, category] == {*listing.bodies, *listing.groups}
        assert found == {False, True} or (category == "joint" and not listing.widen)
