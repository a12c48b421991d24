"""The laws of the categories, over every variant of every page, on compiled and simulated quantities.

Expected values come from the stock Gymnasium model and textbook formulas; of the package only the ids, the
MJCF text and the fields that a category promises to change are used. tests/envs/test_mjcf.py proves the four
original categories on the 154 variants; here are all others.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from test_mjcf import (
    ASSETS,
    DERIVED_FROM_GEOMETRY,
    DERIVED_FROM_INERTIA,
    capsule_volume_and_moments,
    changed_fields,
    load,
    nearest,
    rest,
)

from imujoco_minari.envs.categories import BY_NAME
from imujoco_minari.envs.mjcf import healthy_z_range
from imujoco_minari.variants import (
    CATEGORIES,
    ROBOTS,
    Change,
    Variant,
    catalogue,
    known_robots,
    specification,
)

ORIGINAL = ("mass", "joint", "length", "friction")
OTHERS = [robot for robot in known_robots() if robot not in ROBOTS]
FILES = {"halfcheetah": "half_cheetah.xml", "walker2d": "walker2d_v5.xml"}


def every(category: str) -> list[Variant]:
    """The listed variants, and a decrease and an increase of every body and group of the pages."""
    variants: list[Variant] = []
    for robot in known_robots():
        listing = specification(robot).categories.get(category)
        if listing is None:
            continue
        found = dict.fromkeys(catalogue(robot, category) if robot in OTHERS else ())
        for body in (*listing.bodies, *listing.groups):
            if robot in ROBOTS and category in ORIGINAL and body in listing.bodies:
                continue
            widens = category != "joint" or set(listing.names(body)) <= set(listing.widen)
            for percent in (-37.5, 50) if widens else (-37.5,):
                found[Variant(robot, (Change(category, percent, body),))] = None
        variants += found
    return variants


def of(category: str) -> Any:
    return pytest.mark.parametrize("variant", every(category), ids=str)


def stock(robot: str) -> Any:
    return mujoco.MjModel.from_xml_path(str(ASSETS / FILES.get(robot, f"{robot}.xml")))


def compared(variant: Variant) -> tuple[Any, Any, float, list[str]]:
    """The stock model, ours, the factor, and the MJCF names, after a check of what else has changed."""
    (change,) = variant.changes
    before, after = stock(variant.robot), load(variant)
    law = BY_NAME[change.category]
    derived = DERIVED_FROM_INERTIA | (DERIVED_FROM_GEOMETRY | {"key_qpos"} if law.moves_limbs else set())
    # What MuJoCo derives from springs, motors and armatures.
    derived |= {"dof_invweight0", "actuator_acc0"}
    found = changed_fields(before, after)
    if change.category == "friction":
        # The pair, its place in the file's names, and nothing else.
        found = {name for name in found if "pair" not in name and "name" not in name}
    assert found <= law.fields | derived
    return before, after, 1 + change.percent / 100, list(change.mjcf_names(variant.robot))


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
    # The same force gives a lone body less acceleration: the whole weight is the sum.
    assert after.body_subtreemass[0] == pytest.approx(float(before.body_mass @ factors), rel=1e-12)


@of("joint")
def test_joint_scales_ranges(variant: Variant) -> None:
    before, after, factor, names = compared(variant)
    factors = np.ones(before.njnt)
    factors[[before.joint(name).id for name in names]] = factor
    np.testing.assert_allclose(after.jnt_range, before.jnt_range * factors[:, None], rtol=1e-12)
    assert changed_fields(before, after) == {"jnt_range"}


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
    for model in (before, after):
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
    length, thickness = (factor, 1.0) if variant.category == "length" else (1.0, factor)
    at_rest, changed = rest(before), rest(after)
    for body in range(1, before.nbody):
        if body not in bodies:
            assert after.body_mass[body] == before.body_mass[body]
            assert np.array_equal(after.body_inertia[body], before.body_inertia[body])
            continue
        geom = int(before.body_geomadr[body])
        radius, size = before.geom_size[geom][0], 2 * before.geom_size[geom][1]
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
            assert new_joint - limb_after[end] == pytest.approx(joint - limb_before[end], abs=1e-9)
        if before.body_parentid[body] != 0 and before.body_jntnum[body]:
            joint, new_joint = anchor(before, at_rest, body), anchor(after, changed, body)
            gap, new_gap = nearest(joint, limb_before) - joint, nearest(new_joint, limb_after) - new_joint
            assert new_gap == pytest.approx(gap, abs=1e-9)
    assert bottom(after) == pytest.approx(bottom(before), abs=1e-9)
    raised = after.body_pos[1][2] - before.body_pos[1][2]
    heights, base = healthy_z_range(variant), specification(variant.robot).healthy_z_range
    if base is None:
        assert heights is None
    else:
        assert heights == pytest.approx((base[0] + raised, base[1] + raised))


@of("friction")
def test_friction_of_simulated_contacts_of_feet_and_floor_scales(variant: Variant) -> None:
    before, after, factor, names = compared(variant)
    base, ours = contacts(before), contacts(after)
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
            met[geoms] = (found.friction.copy(), found.dim, found.solref.copy(), found.solimp.copy())
    return met


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
    assert all(len(every(category)) >= 4 for category in CATEGORIES)
