"""Variants with several changes: one id for each, whatever the order."""

from __future__ import annotations

import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imujoco_minari.errors import VariantError
from imujoco_minari.variants import ROBOTS, Variant, parse_dataset_id, specification
from imujoco_minari.variants.compound import COMPOUND, compound
from imujoco_minari.variants.context import parameters, percents
from imujoco_minari.variants.original import names_variant

TWO = "hopper-massinc_50_torsogeom-frictiondec_12p25_feet"


@st.composite
def changes(draw: st.DrawFn) -> list[Variant]:
    robot = draw(st.sampled_from(ROBOTS))
    names = draw(st.lists(st.sampled_from(parameters(robot)), min_size=2, max_size=5, unique=True))
    return [Variant(robot, *_percent(draw, name)) for name in names]


def _percent(draw: st.DrawFn, name: str) -> tuple[str, float, str]:
    category, _, body = name.partition("/")
    return category, draw(st.integers(-9999, 0 if category == "joint" else 20_000)) / 100, body


@given(changes(), st.randoms())
def test_an_id_names_all_changes_in_one_order_and_reads_back(single: list[Variant], random: object) -> None:
    whole = compound(single)
    random.shuffle(single)  # type: ignore[attr-defined]
    assert compound(single) == whole == Variant.parse(str(whole)) == pickle.loads(pickle.dumps(whole))
    assert Variant.parse(f"{whole.robot}-" + "-".join(str(one).partition("-")[2] for one in single)) == whole
    assert {f"{one.category}/{one.body}": one.percent for one in single} == percents(whole)
    assert list(percents(whole)) == [name for name in parameters(whole.robot) if name in percents(whole)]


@given(st.integers(-9999, 1_000_000))
def test_a_percent_of_two_decimals_reads_back(hundredths: int) -> None:
    variant = Variant("hopper", "mass", hundredths / 100, "leggeom")
    assert Variant.parse(str(variant)) == variant
    assert isinstance(variant.percent, int) == (hundredths % 100 == 0)
    assert round(variant.factor * 10_000) == 10_000 + hundredths


def test_a_compound_variant_describes_itself() -> None:
    variant = Variant.parse(TWO)
    assert (variant.robot, variant.category, variant.percent, variant.body) == ("hopper", COMPOUND, 0, "")
    assert [str(change) for change in variant.changes] == [
        "hopper-massinc_50_torsogeom",
        "hopper-frictiondec_12p25_feet",
    ]
    assert variant.mjcf_names == ("torso_geom", *specification("hopper").feet)
    assert variant.base == Variant.parse("hopper-base")
    assert Variant.parse("hopper-base").changes == ()
    assert Variant.parse("hopper-massdec_25_leggeom").changes == (Variant.parse("hopper-massdec_25_leggeom"),)


def test_a_dataset_id_names_a_compound_variant_and_a_tier() -> None:
    assert parse_dataset_id(f"imujoco/{TWO}-v0") == (Variant.parse(TWO), "expert")
    assert parse_dataset_id(f"imujoco/{TWO}-medium-expert-v0") == (Variant.parse(TWO), "medium-expert")
    assert names_variant(f"imujoco/{TWO}-random-v0")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hopper-massinc_50_leggeom-massdec_5_leggeom", "'mass/leggeom' stands twice"),
        ("hopper-massinc_50_leggeom-massdec_5_legeom", r"no body 'legeom' for mass \(did you mean"),
        ("hopper-massinc_50_leggeom-random", "malformed variant id"),
        ("hopper-massinc_50p250_leggeom", "at most two decimals, without zeros at the end"),
        ("hopper-massinc_50p123_leggeom", "at most two decimals"),
        ("hopper-massinc_50p0_leggeom", "without zeros at the end"),
        ("hopper-massdec_100p5_leggeom", "leaves nothing of the mass"),
    ],
)
def test_bad_ids_are_refused(text: str, message: str) -> None:
    with pytest.raises(VariantError, match=message):
        Variant.parse(text)


def test_only_single_changes_of_one_robot_combine() -> None:
    names = ["hopper-base", "hopper-massinc_50_leggeom", "walker2d-massinc_50_leggeom", TWO]
    base, leg, other, two = map(Variant.parse, names)
    assert compound([leg]) == leg
    for single, message in (
        ([leg, base], "hopper-base is not the change of one parameter"),
        ([leg, two], "is not the change of one parameter"),
        ([leg, other], "one robot, not hopper, walker2d"),
        ([], "not none"),
    ):
        with pytest.raises(VariantError, match=message):
            compound(single)
    for percent in (0.125, float("nan"), float("inf"), True, "5"):
        with pytest.raises(VariantError, match="number with at most two decimals"):
            Variant("hopper", "mass", percent, "leggeom")  # type: ignore[arg-type]
