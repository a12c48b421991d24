"""Variants with several changes: one id for each, whatever the order."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imujoco_minari.errors import VariantError
from imujoco_minari.variants import COMPOUND, ROBOTS, Change, Variant, parse_dataset_id, specification
from imujoco_minari.variants.context import parameters, percents
from imujoco_minari.variants.original import names_variant

TWO = "hopper-massinc_50_torsogeom-frictiondec_12p25_feet"


@st.composite
def several(draw: st.DrawFn) -> tuple[str, list[Change]]:
    robot = draw(st.sampled_from(ROBOTS))
    names = draw(st.lists(st.sampled_from(parameters(robot)), min_size=2, max_size=5, unique=True))
    return robot, [Change(*_percent(draw, name)) for name in names]


def _percent(draw: st.DrawFn, name: str) -> tuple[str, float, str]:
    category, _, body = name.partition("/")
    return category, draw(st.integers(-9999, 0 if category == "joint" else 20_000)) / 100, body


@given(several(), st.randoms())
def test_an_id_names_all_changes_in_one_order_and_reads_back(
    given: tuple[str, list[Change]], random: object
) -> None:
    robot, changes = given
    whole = Variant(robot, tuple(changes))
    random.shuffle(changes)  # type: ignore[attr-defined]
    assert Variant(robot, tuple(changes)) == whole == Variant.parse(str(whole))
    assert pickle.loads(pickle.dumps(whole)) == whole
    assert Variant.parse("-".join([robot, *map(str, changes)])) == whole
    assert {f"{one.category}/{one.body}": one.percent for one in changes} == percents(whole)
    assert list(percents(whole)) == [name for name in parameters(robot) if name in percents(whole)]


@given(st.integers(-9999, 1_000_000))
def test_a_percent_of_two_decimals_reads_back(hundredths: int) -> None:
    change = Change("mass", hundredths / 100, "leggeom")
    assert Change.parse(str(change)) == change
    assert isinstance(change.percent, int) == (hundredths % 100 == 0)
    assert round(change.factor * 10_000) == 10_000 + hundredths


def test_a_compound_variant_describes_itself() -> None:
    variant = Variant.parse(TWO)
    assert (variant.robot, variant.category, variant.percent, variant.body) == ("hopper", COMPOUND, 0, "")
    assert list(map(str, variant.changes)) == ["massinc_50_torsogeom", "frictiondec_12p25_feet"]
    assert variant.mjcf_names == ("torso_geom", *specification("hopper").feet)
    assert variant.base == Variant.parse("hopper-base")
    assert variant.base.changes == ()


def test_a_dataset_id_names_a_compound_variant_and_a_tier() -> None:
    assert parse_dataset_id(f"imujoco/{TWO}-v0") == (Variant.parse(TWO), "expert")
    assert parse_dataset_id(f"imujoco/{TWO}-medium-expert-v0") == (Variant.parse(TWO), "medium-expert")
    assert names_variant(f"imujoco/{TWO}-random-v0")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hopper-massinc_50_leggeom-massdec_5_leggeom", "the mass of leg_geom is changed twice"),
        (
            "hopper-massinc_50_leggeom-massdec_5_legeom",
            r"the mass of hopper has no body 'legeom' \(did you mean",
        ),
        ("hopper-massinc_50_leggeom-random", "malformed variant id"),
        ("hopper-massinc_50p250_leggeom", "write 'massinc_50p250_leggeom' as 'massinc_50p25_leggeom'"),
        ("hopper-massinc_50p123_leggeom", "at most two decimals"),
        ("hopper-massinc_50p0_leggeom", "as 'massinc_50_leggeom'"),
        ("hopper-massdec_100p5_leggeom", "leaves nothing of the mass"),
    ],
)
def test_bad_ids_are_refused(text: str, message: str) -> None:
    with pytest.raises(VariantError, match=message):
        Variant.parse(text)


def test_a_percent_is_a_number() -> None:
    for percent in (np.int64(50), np.float32(50), np.float64(50)):
        change = Change("mass", percent, "leggeom")  # type: ignore[arg-type]
        assert (str(change), type(change.percent)) == ("massinc_50_leggeom", int)
    for percent in (0.125, float("nan"), float("inf"), True, np.True_, "5"):
        with pytest.raises(VariantError, match="number with at most two decimals"):
            Change("mass", percent, "leggeom")  # type: ignore[arg-type]
