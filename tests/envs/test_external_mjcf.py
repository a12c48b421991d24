"""The original's ids, models and environments."""

from __future__ import annotations

import json
import pickle

import gymnasium as gym
import mujoco
import numpy as np
import original_archive
import pytest

import imujoco_minari
from imujoco_minari.envs import collection_spec, environment_spec, mjcf, untrusted_mjcf
from imujoco_minari.envs.differences import model_differences
from imujoco_minari.envs.external_mjcf import canonical_external_mjcf
from imujoco_minari.envs.registration import current_spec, dataset_spec, is_entry_point, stored_models
from imujoco_minari.envs.untrusted_mjcf import check_mjcf
from imujoco_minari.errors import ModelError, RenderingError, VariantError
from imujoco_minari.importing.catalogue_diff import common_differences, coverage, departure
from imujoco_minari.limits import run_limited
from imujoco_minari.pictures.rendering.scene import COLOURS, scene_model
from imujoco_minari.variants import ROBOTS, Variant, bases, catalogue, specification
from imujoco_minari.variants.original import OriginalVariant

# Every numeric field that decides how a model moves.
FIELDS = (
    *("body_mass", "body_inertia", "body_pos", "body_quat", "body_ipos", "body_iquat", "qpos0", "jnt_pos"),
    *("jnt_axis", "jnt_range", "jnt_stiffness", "dof_damping", "dof_armature", "actuator_gear"),
    *("geom_pos", "geom_quat", "geom_size", "geom_friction", "geom_condim", "geom_margin", "geom_solimp"),
)


def base_xml(robot: str) -> str:
    """gym's own model, of a change of 0 %."""
    body = {"hopper": "leggeom", "halfcheetah": "bfoot", "walker2d": "leggeom"}[robot]
    return original_archive.gym_xml(f"{robot}-massinc_0_{body}")


def compiled(text: str, robot: str) -> mujoco.MjModel:
    return mjcf.compile_mjcf(canonical_external_mjcf(text, robot, "test"))


def test_an_original_id_reads_back_and_names_its_datasets() -> None:
    variant = OriginalVariant.parse("halfcheetah-jointdec_25_bfoot")
    assert str(variant) == "halfcheetah-jointdec_25_bfoot"
    assert (variant.category, variant.percent, variant.body) == ("joint", -25, "bfoot")
    assert variant.dataset_id() == "imujoco-original/halfcheetah-jointdec_25_bfoot-v0"
    assert (
        variant.dataset_id("recollected") == "imujoco-original/halfcheetah-jointdec_25_bfoot-recollected-v0"
    )
    assert variant.ours == Variant.parse("halfcheetah-jointdec_25_bfoot")


def test_a_body_that_our_catalogue_lacks_is_an_original_all_the_same() -> None:
    variant = OriginalVariant.parse("walker2d-frictiondec_50_footleftgeom")
    assert variant.ours is None
    assert variant != Variant("walker2d")


@pytest.mark.parametrize(
    "text",
    [
        "ant-massdec_25_leg",
        "hopper-colordec_25_leg",
        "hopper-massdec_100_leg",
        "hopper-massdec_25_",
        "../x",
        "",
    ],
)
def test_what_is_no_original_id_is_refused(text: str) -> None:
    with pytest.raises(VariantError):
        OriginalVariant.parse(text)


@pytest.mark.parametrize("robot", ROBOTS)
def test_global_coordinates_become_local_ones_exactly(robot: str) -> None:
    ours = mjcf.compile_mjcf(mjcf.canonical_mjcf(Variant(robot)))
    theirs = compiled(base_xml(robot), robot)
    for field in FIELDS:
        if robot == "walker2d" and field == "geom_friction":
            continue
        np.testing.assert_allclose(
            getattr(theirs, field), getattr(ours, field), rtol=0, atol=1e-14, err_msg=field
        )


def test_walker2d_of_gym_has_one_slippery_foot() -> None:
    ours = mjcf.compile_mjcf(mjcf.canonical_mjcf(Variant("walker2d")))
    (difference,) = model_differences(ours, compiled(base_xml("walker2d"), "walker2d"))
    assert difference.quantity == "friction of foot_geom on floor"
    assert (difference.before, difference.after) == (1.9, 0.9)


def test_the_canonical_text_is_a_fixed_point() -> None:
    once = canonical_external_mjcf(base_xml("hopper"), "hopper", "test")
    assert canonical_external_mjcf(once, "hopper", "test") == once


def textures(count: int, width: int) -> str:
    sizes = f'width="{width}" height="{width}"'
    return "".join(f'<texture name="t{i}" type="cube" builtin="flat" {sizes}/>' for i in range(count))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<worldbody>", '<include file="/etc/passwd"/><worldbody>', "<include> is refused"),
        ("<worldbody>", '<extension><plugin plugin="x"/></extension><worldbody>', "<extension> is refused"),
        ("<asset>", '<asset><mesh name="m" file="m.obj"/>', "<mesh> is refused"),
        ("<asset>", '<asset><hfield name="h" file="h.png"/>', "<hfield> is refused"),
        ("<asset>", '<asset><texture name="t" type="2d" file="/etc/passwd"/>', 'file="/etc/passwd"'),
        ("<asset>", '<asset><texture name="t" type="cube" fileright="a.png"/>', "fileright"),
        ("<compiler ", '<compiler meshdir="/" ', "meshdir"),
        ('width="127"', 'width="+1300"', "ntexdata of the compiled model is"),
        ('width="127"', 'width="+40000"', "Could not allocate memory"),
        ("<asset>", f"<asset>{textures(60, 4000)}", "Could not allocate memory"),
        ("<asset>", f"<asset>{textures(30, 512)}", "nbuffer of the compiled model is"),
        ("<worldbody>", '<size memory="900G"/><worldbody>', "Could not allocate memory"),
        ("<worldbody>", '<size memory="200M"/><worldbody>', "narena of the compiled model is"),
        ("<worldbody>", '<option iterations="+2000000000"/><worldbody>', "opt.iterations of the compiled"),
        ("<worldbody>", '<option timestep="1e-9"/><worldbody>', "opt.timestep of the compiled model is"),
        ("<worldbody>", "<worldbody>" + '<geom size="1"/>' * 200, "ngeom of the compiled model is"),
        (
            "<worldbody>",
            '<visual><global offwidth="+90000"/></visual><worldbody>',
            "offwidth of the",
        ),
        ("<worldbody>", '<replicate count="1000000"/><worldbody>', "<replicate> is refused"),
        ('width="127"', 'width="' + "9" * 5000 + '"', "cannot compile"),
        ('gear="200.0"', 'gear="nan"', "is no number"),
        ('name="thigh"', 'name="knee"', "is no hopper"),
        ('joint="foot_joint"', 'joint="leg_joint"', "actuated joints"),
        ('type="capsule"', 'type="blob"', "cannot compile"),
        ("<mujoco", "<robot", "not XML"),
    ],
)
def test_a_model_that_is_unsafe_or_of_another_robot_is_refused(old: str, new: str, message: str) -> None:
    text = base_xml("hopper")
    assert old in text
    with pytest.raises(ModelError, match=message):
        canonical_external_mjcf(text.replace(old, new), "hopper", "test")


def test_a_stored_text_is_bounded_as_it_stands() -> None:
    text = mjcf.canonical_mjcf(Variant("hopper"))
    for change, message in (
        ('<size nstack="+900000000"/>', "Could not allocate memory"),
        ('<size nstack="+20000000"/>', "narena of the compiled model is"),
        ('<option iterations="+2000000000" tolerance="0"/>', "opt.iterations of the compiled model is"),
    ):
        hostile = text.replace("<worldbody>", f"{change}<worldbody>")
        with pytest.raises(ModelError, match=message):
            gym.make(environment_spec("hopper-massinc_0_any", hostile))


def test_a_text_is_compiled_apart_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def counted(*arguments: str, **limits: int) -> bytes:
        calls.append(arguments)
        return run_limited(*arguments, **limits)

    monkeypatch.setattr(untrusted_mjcf, "run_limited", counted)
    monkeypatch.setattr(untrusted_mjcf, "WITHIN_BOUNDS", set())
    text = mjcf.canonical_mjcf(Variant.parse("hopper-massinc_3_leggeom"))
    for _ in range(2):
        check_mjcf(text, "test")
    assert len(calls) == 1
    for _ in range(2):
        canonical = canonical_external_mjcf(base_xml("walker2d"), "walker2d", "test")
    assert len(calls) == 2
    check_mjcf(canonical, "test")
    assert len(calls) == 2


def test_a_child_that_is_killed_is_a_model_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(untrusted_mjcf, "WITHIN_BOUNDS", set())
    monkeypatch.setattr(untrusted_mjcf, "_MEASURE", "limited_calls:crash")
    with pytest.raises(ModelError, match=r"test: compiling the model kills the process \(SIGSEGV\)"):
        canonical_external_mjcf(base_xml("hopper"), "hopper", "test")


@pytest.mark.parametrize("variant", [*bases(), *catalogue(category="length")], ids=str)
def test_our_own_models_are_far_within_the_bounds(variant: Variant) -> None:
    fields = untrusted_mjcf.measure(mjcf.compile_mjcf(mjcf.canonical_mjcf(variant)))
    for field, (_, high) in untrusted_mjcf._BOUNDS.items():
        assert fields[field] <= high / 2, field


def test_entities_and_sizes_are_refused_before_parsing() -> None:
    bomb = '<!DOCTYPE m [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><mujoco model="&b;"/>'
    with pytest.raises(ModelError, match="DOCTYPE"):
        canonical_external_mjcf(bomb, "hopper", "test")
    with pytest.raises(ModelError, match="the limit is"):
        canonical_external_mjcf("<mujoco>" + " " * 50_000 + "</mujoco>", "hopper", "test")
    with pytest.raises(ModelError, match="nested deeper"):
        canonical_external_mjcf("<mujoco>" + "<body>" * 60 + "</body>" * 60 + "</mujoco>", "hopper", "test")


def test_the_environment_is_made_from_its_spec_alone_and_pickles() -> None:
    variant = OriginalVariant.parse("hopper-massdec_25_leggeom")
    text = canonical_external_mjcf(original_archive.gym_xml(str(variant)), "hopper", "test")
    spec = gym.envs.registration.EnvSpec.from_json(environment_spec(variant, text).to_json())
    env, ours = gym.make(spec), imujoco_minari.make("hopper-massdec_25_leggeom")
    again = pickle.loads(pickle.dumps(env.unwrapped))
    action = np.full(3, 0.5, np.float32)
    for each in (env, ours, again):
        each.reset(seed=5)
    steps = [each.step(action)[0] for each in (env, ours, again)]
    np.testing.assert_allclose(steps[0], steps[1], atol=1e-12)
    np.testing.assert_array_equal(steps[0], steps[2])
    env.close()
    ours.close()


def test_an_environment_never_loads_what_a_hostile_spec_names() -> None:
    variant = OriginalVariant.parse("hopper-massdec_25_leggeom")
    text = base_xml("hopper").replace("<asset>", '<asset><mesh name="m" file="/etc/passwd"/>')
    with pytest.raises(ModelError, match="<mesh> is refused"):
        gym.make(environment_spec(variant, text))


def test_a_spec_of_several_originals_gives_its_models_back() -> None:
    variants = [OriginalVariant.parse(f"hopper-massdec_{percent}_leggeom") for percent in (25, 50)]
    models = {
        str(v): canonical_external_mjcf(original_archive.gym_xml(str(v)), "hopper", "t") for v in variants
    }
    spec = collection_spec("hopper-two", variants, models)
    assert spec.id == "imujoco-original/hopper-two-v0"
    assert stored_models(spec.kwargs) == models
    env = gym.make(spec)
    _, info = env.reset(seed=0, options={"variant": "hopper-massdec_50_leggeom"})
    assert info["variant"] == "hopper-massdec_50_leggeom"
    assert env.unwrapped.variants == tuple(map(str, variants))  # type: ignore[attr-defined]
    env.close()


def earlier_spec(name: str, **kwargs: object) -> gym.envs.registration.EnvSpec:
    """A spec as versions before VariantEnv took a text stored it."""
    return gym.envs.registration.EnvSpec(
        id="imujoco-original/any-v0",
        entry_point=f"imujoco_minari.importing.environments:Original{name}Env",
        max_episode_steps=1000,
        kwargs=kwargs,
    )


@pytest.mark.parametrize("robot", ROBOTS)
def test_an_earlier_spec_makes_the_same_environment_and_equals_todays(robot: str) -> None:
    name = f"{robot}-massinc_0_{'bfoot' if robot == 'halfcheetah' else 'leggeom'}"
    text = canonical_external_mjcf(base_xml(robot), robot, "test")
    earlier = earlier_spec(specification(robot).title, variant=name, mjcf=text)
    today = environment_spec(name, text)
    assert current_spec(json.loads(earlier.to_json())) == json.loads(today.to_json()) | {"id": earlier.id}
    first, second = gym.make(earlier), gym.make(today)
    action = np.full(first.action_space.shape, 0.5, np.float32)
    for each in (first, second):
        each.reset(seed=5)
    np.testing.assert_array_equal(first.step(action)[0], second.step(action)[0])
    first.close()
    second.close()


def test_an_earlier_spec_of_a_collection_equals_todays() -> None:
    text = canonical_external_mjcf(base_xml("hopper"), "hopper", "test")
    models = {f"hopper-massinc_{percent}_leggeom": text for percent in (0, 1)}
    earlier, today = earlier_spec("Collection", models=models), dataset_spec("any", list(models), models)
    assert current_spec(json.loads(earlier.to_json())) == json.loads(today.to_json())
    env = gym.make(earlier)
    again = pickle.loads(pickle.dumps(env.unwrapped))
    assert again.variants == env.unwrapped.variants == tuple(models)  # type: ignore[attr-defined]
    env.close()


def test_a_spec_that_is_no_earlier_one_stays_as_it_is() -> None:
    for entry_point in ("imujoco_minari.envs:HopperVariantEnv", "os:system", None, 5):
        assert current_spec({"entry_point": entry_point}) == {"entry_point": entry_point}
    assert is_entry_point("imujoco_minari.envs:CollectionEnv")
    for other in ("imujoco_minari.envs:make", "imujoco_minari.importing.environments:OriginalCrabEnv", None):
        assert not is_entry_point(current_spec({"entry_point": other})["entry_point"])


def test_a_text_belongs_to_variants_of_the_archive_only() -> None:
    original = OriginalVariant.parse("hopper-massdec_25_leggeom")
    with pytest.raises(VariantError, match="needs the text of its model"):
        environment_spec(original)
    with pytest.raises(VariantError, match="follows from its id"):
        environment_spec(Variant.parse(str(original)), "<mujoco/>")
    with pytest.raises(VariantError, match="share no environment"):
        dataset_spec("mixed", [original, Variant.parse("hopper-base")], {str(original): "<mujoco/>"})
    with pytest.raises(ModelError, match="needs the text of its model"):
        mjcf.model_text(original)


@pytest.mark.parametrize("name", ["hopper-massdec_25_leggeom", "walker2d-frictiondec_50_footleftgeom"])
def test_an_original_is_drawn_by_its_own_model(name: str) -> None:
    variant = OriginalVariant.parse(name)
    text = canonical_external_mjcf(original_archive.gym_xml(name), variant.robot, "test")
    scene, plain = scene_model(variant, text, width=320, height=240), mjcf.compile_mjcf(text)
    assert np.array_equal(scene.geom_size[1:], plain.geom_size[1:])
    assert scene.body("foot").mass[0] == plain.body("foot").mass[0]
    coloured = [i for i in range(scene.ngeom) if np.allclose(scene.geom_rgba[i][:3], COLOURS["mass"])]
    # Our catalogue does not know the walker's foot as a body for friction, so nothing is coloured.
    assert [scene.geom(i).name for i in coloured] == (["leg_geom"] if variant.ours else [])
    renamed = text.replace('name="floor"', 'name="ground"')
    assert scene_model(variant, renamed, width=320, height=240).geom("ground").matid[0] >= 0
    with pytest.raises(RenderingError, match="no floor, a geom that is a plane"):
        scene_model(variant, renamed.replace('type="plane"', 'type="box"'), width=320, height=240)


def test_a_departure_names_the_quantities() -> None:
    variant = OriginalVariant.parse("hopper-lengthinc_50_thighgeom")
    # This fixture lengthens the capsule alone, about its centre, and moves nothing that hangs on it.
    text = canonical_external_mjcf(original_archive.gym_xml(str(variant)), "hopper", "test")
    found = departure(variant, text)
    assert found.same_id
    quantities = {difference.quantity: difference for difference in found.differences}
    assert quantities["height of the root"].before == pytest.approx(1.25 + 0.225)
    assert quantities["height of the root"].after == pytest.approx(1.25)
    assert "length of thigh_geom" not in quantities


def test_a_departure_names_each_quantity_once() -> None:
    variant = OriginalVariant.parse("hopper-massdec_25_leggeom")
    text = mjcf.canonical_mjcf(Variant.parse(str(variant)))
    for before, after in (('gear="200', 'gear="250'), ("<option", '<option gravity="0 0 -5"')):
        assert before in text
        text = text.replace(before, after)
    found = departure(variant, text).differences
    joints = ("thigh_joint", "leg_joint", "foot_joint")
    assert [each.quantity for each in found] == [*(f"gear of {joint}" for joint in joints), "gravity"]


def test_a_total_mass_that_is_set_moves_every_mass() -> None:
    variant = OriginalVariant.parse("halfcheetah-massinc_100_bthigh")
    text = canonical_external_mjcf(original_archive.gym_xml(str(variant)), "halfcheetah", "test")
    found = departure(variant, text)
    masses = [difference for difference in found.differences if difference.quantity.startswith("mass of")]
    assert len(masses) == 7
    assert all(difference.after < difference.before for difference in masses)


def test_what_most_variants_share_is_said_once() -> None:
    ids = [
        f"walker2d-{change}"
        for change in ("massinc_50_leggeom", "massdec_50_torsogeom", "jointdec_25_legjoint")
    ]
    departures = []
    for name in ids:
        variant = OriginalVariant.parse(name)
        text = canonical_external_mjcf(original_archive.gym_xml(name), "walker2d", "test")
        departures.append(departure(variant, text))
    (shared,) = common_differences(departures)["walker2d"].items()
    assert shared[0].quantity == "friction of foot_geom on floor"
    assert shared[1] == 3


def test_coverage_tells_the_ids_apart() -> None:
    names = ("hopper-massdec_25_leggeom", "hopper-frictiondec_50_footgeom")
    found = coverage([OriginalVariant.parse(name) for name in names], "hopper", None)
    assert found.both == names[:1]
    assert found.only_original == names[1:]
    assert len(found.only_ours) == 36
