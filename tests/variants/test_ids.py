"""The grammar of ids and the catalogue."""

from __future__ import annotations

import pickle

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imujoco_minari.errors import ImujocoError, VariantError
from imujoco_minari.variants import (
    CATEGORIES,
    ROBOTS,
    Change,
    Variant,
    bases,
    catalogue,
    known_robots,
    parse_dataset_id,
    specification,
)
from imujoco_minari.variants.context import parameters, percents
from imujoco_minari.variants.original import names_variant


def test_catalogue_has_the_published_counts() -> None:
    counts = {robot: len(catalogue(robot)) for robot in ROBOTS}
    assert counts == {"hopper": 37, "halfcheetah": 53, "walker2d": 64}
    assert len(set(catalogue())) == 154
    assert not set(bases()) & set(catalogue())


def test_catalogue_holds_the_names_known_from_the_original() -> None:
    ids = {str(variant) for variant in catalogue()}
    assert {
        "hopper-massdec_25_leggeom",
        "hopper-massdec_50_footgeom",
        "halfcheetah-jointdec_25_bfoot",
        "halfcheetah-jointdec_25_bshin",
    } <= ids


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("category", CATEGORIES[:4])
def test_filters_keep_what_they_name(robot: str, category: str) -> None:
    chosen = catalogue(robot, category)
    assert chosen
    assert {(v.robot, v.category) for v in chosen} == {(robot, category)}


@st.composite
def variants(draw: st.DrawFn) -> Variant:
    robot = draw(st.sampled_from(known_robots()))
    found: dict[tuple[str, str], Change] = {}
    for _ in range(draw(st.integers(1, 3))):
        category = draw(st.sampled_from(sorted(specification(robot).categories)))
        listing = specification(robot).categories[category]
        # A group and one of its members are the same parameter.
        names = listing.bodies if found else {**listing.bodies, **listing.groups}
        body = draw(st.sampled_from(sorted(names)))
        if found and set(listing.names(body)) & {n for c in found.values() for n in c.mjcf_names(robot)}:
            continue
        hundredths = draw(st.integers(-9999, 0 if category == "joint" else 10**6))
        found[category, body] = Change(category, hundredths / 100, body)
    return Variant(robot, tuple(draw(st.permutations(list(found.values())))))


@given(variants())
def test_parsing_undoes_formatting(variant: Variant) -> None:
    assert Variant.parse(str(variant)) == variant
    assert Variant.parse(variant.environment_id) == variant
    assert parse_dataset_id(variant.dataset_id()) == (variant, "expert")
    assert parse_dataset_id(variant.dataset_id("medium-expert")) == (variant, "medium-expert")
    assert names_variant(variant.dataset_id("random"))
    assert pickle.loads(pickle.dumps(variant)) == variant
    assert all(change.factor == pytest.approx(1 + change.percent / 100) for change in variant.changes)
    assert list(percents(variant)) == [
        name for name in parameters(variant.robot, groups=True) if name in percents(variant)
    ]
    assert gym.envs.registration.parse_env_id(variant.environment_id)[1] == str(variant)


@given(st.integers(-9999, 1_000_000))
def test_a_percent_of_two_decimals_reads_back(hundredths: int) -> None:
    change = Change("mass", hundredths / 100, "leggeom")
    assert Change.parse(str(change)) == change
    assert isinstance(change.percent, int) == (hundredths % 100 == 0)
    assert round(change.factor * 10_000) == 10_000 + hundredths


def test_the_order_of_changes_does_not_matter() -> None:
    one = Variant.parse("hopper-frictiondec_50_feet-massinc_37p5_torsogeom")
    assert str(one) == "hopper-massinc_37p5_torsogeom-frictiondec_50_feet"
    assert one == Variant("hopper", tuple(reversed(one.changes)))
    assert one.base == Variant.parse("hopper-base") == Variant("hopper")
    assert [change.percent for change in one.changes] == [37.5, -50]
    assert (one.category, one.body, one.percent) == ("compound", "", 0)
    assert one.mjcf_names == ("torso_geom", "foot_geom")
    dataset = "imujoco/hopper-massinc_37p5_torsogeom-frictiondec_50_feet-medium-expert-v0"
    assert parse_dataset_id(dataset) == (one, "medium-expert")


def test_a_group_changes_all_its_members() -> None:
    variant = Variant.parse("walker2d-jointdec_50_thighjoints")
    assert variant.mjcf_names == ("thigh_joint", "thigh_left_joint")
    assert variant not in catalogue()


def test_a_joint_may_widen_where_its_page_allows_it() -> None:
    assert Variant.parse("hopper-jointinc_25_footjoint").percent == 25


@given(st.text(max_size=60) | st.from_regex(r"[a-z0-9]+-[a-z]+_[0-9]+_[a-z]+", fullmatch=True))
def test_any_text_is_a_variant_or_a_variant_error(text: str) -> None:
    try:
        variant = Variant.parse(text)
    except VariantError:
        return
    assert str(variant) in text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("hoper-massdec_25_leggeom", ["did you mean 'hopper'", "halfcheetah, walker2d"]),
        ("hopper-masdec_25_leggeom", ["hopper has no category 'mas'", "did you mean 'mass'"]),
        ("hopper-massdec_25_leggom", ["no body 'leggom'", "did you mean 'leggeom'", "torsogeom, thighgeom"]),
        ("hopper-massdec_100_leggeom", ["percent -100", "above -100"]),
        ("hopper-massdec_250_leggeom", ["percent -250"]),
        ("hopper-massinc_10001_leggeom", ["at most 10000"]),
        ("hopper-massinc_" + "9" * 50 + "_leggeom", ["too large"]),
        ("hopper-jointinc_25_legjoint", ["can only shrink"]),
        ("walker2d-jointinc_5_legjoints", ["can only shrink"]),
        ("hopper-massdec_25_legs", ["no body 'legs'", "torsogeom"]),
        (
            "swimmer-frictiondec_5_feet",
            ["swimmer has no category 'friction'", "mass, joint, length"],
        ),
        ("hopper-massinc_5_leggeom-massinc_6_leggeom", ["the mass of leg_geom is changed twice"]),
        ("walker2d-jointdec_5_legjoints-jointdec_6_legjoint", ["joint of leg_joint is changed twice"]),
        ("hopper-massinc_37p50_leggeom", ["as 'massinc_37p5_leggeom'"]),
        ("hopper-massinc_1p1234567_leggeom", ["at most two decimals"]),
        ("hopper-massinc_5_leggeom-base", ["malformed"]),
        ("hopper-massinc_5_leggeom-random", ["malformed variant id"]),
        ("hopper-massinc_5_leggeom-massdec_5_legeom", ["no body 'legeom'", "did you mean"]),
        ("hopper-massdec_100p5_leggeom", ["leaves nothing of the mass"]),
        ("hopper-massinc_50p0_leggeom", ["as 'massinc_50_leggeom'"]),
        ("hopper-massdec_025_leggeom", ["as 'massdec_25_leggeom'"]),
        ("hopper-massdec_0_leggeom", ["as 'massinc_0_leggeom'"]),
        (
            "crab-base",
            ["unknown robot 'crab'", "valid: hopper, halfcheetah, walker2d, ", "--catalogue load the page"],
        ),
        ("hopper-leggeom", ["malformed", "as in hopper-massdec_25_leggeom"]),
        ("hopper", ["malformed"]),
        ("hopper-mass", ["names several variants", "`imujoco list --robot hopper` lists them"]),
        ("hopper-randomised", ["names several variants"]),
        ("../hopper-base", ["unknown robot '../hopper'"]),
        ("", ["malformed"]),
    ],
)
def test_a_wrong_id_says_what_is_wrong_and_what_is_right(text: str, words: list[str]) -> None:
    with pytest.raises(VariantError) as caught:
        Variant.parse(text)
    message = str(caught.value)
    assert all(word in message for word in words), message
    assert len(message) < 400
    assert isinstance(caught.value, ImujocoError)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("imujoco/hopper-base-v7", ["'imujoco/hopper-base-v7' is not the dataset id", "[-<tier>]-v0"]),
        ("imujoco/hopper-base-v00", ["is not the dataset id of a variant"]),
        ("imujoco-original/hopper-base-v0", ["is not the dataset id of a variant"]),
        ("hopper-base-v0", ["is not the dataset id of a variant"]),
        ("imujoco/hopper-base-expert-v0", ["did you mean 'imujoco/hopper-base-v0'?"]),
        (
            "imujoco/hopper-frictiondec_50_feet-massinc_50_torsogeom-random-v0",
            ["did you mean 'imujoco/hopper-massinc_50_torsogeom-frictiondec_50_feet-random-v0'?"],
        ),
        ("imujoco/hopper-base-Random-v0", ["malformed tier 'Random'"]),
        ("imujoco/hoper-base-v0", ["unknown robot 'hoper'", "did you mean 'hopper'"]),
        ("imujoco/hopper-all-v0", ["'hopper-all' names several variants"]),
    ],
)
def test_only_the_dataset_id_of_a_variant_is_one(text: str, words: list[str]) -> None:
    with pytest.raises(VariantError) as caught:
        parse_dataset_id(text)
    assert all(word in str(caught.value) for word in words), caught.value
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("tier", ["", "massinc_5_leggeom", "Expert", "../x", "a b", "-x", "x" * 50])
def test_a_wrong_tier_is_refused(tier: str) -> None:
    with pytest.raises(VariantError, match="malformed tier"):
        Variant.parse("hopper-base").dataset_id(tier)


@pytest.mark.parametrize("variant", ["hopper-base", "hopper-massdec_25_leggeom"])
def test_a_dataset_id_in_place_of_a_variant_id_names_its_variant(variant: str) -> None:
    with pytest.raises(VariantError, match=f"is a dataset id, not a variant id; its variant is '{variant}'$"):
        Variant.parse(f"imujoco/{variant}-medium-expert-v0")


def test_a_percent_is_a_number() -> None:
    for percent in (np.int64(50), np.float32(50), np.float64(50)):
        change = Change("mass", percent, "leggeom")  # type: ignore[arg-type]
        assert (str(change), type(change.percent)) == ("massinc_50_leggeom", int)
    for percent in (0.125, float("nan"), float("inf"), True, np.True_, "5"):
        with pytest.raises(VariantError, match="number with at most two decimals"):
            Change("mass", percent, "leggeom")  # type: ignore[arg-type]
