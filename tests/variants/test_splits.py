"""Splits: named sets of held-out variants."""

from __future__ import annotations

import hashlib
from typing import Any

import pytest

from imujoco_minari.errors import VariantError
from imujoco_minari.variants import CATEGORIES, ROBOTS, Variant, catalogue
from imujoco_minari.variants.splits import HeldOut, held_out, held_out_names


@pytest.mark.parametrize("name", held_out_names())
def test_every_split_partitions_its_robots_variants(name: str) -> None:
    split = held_out(name)
    assert split.name == name
    assert name.endswith("-v1")
    if not name.startswith("robots-"):
        assert split.robots == (name.split("-")[0],)
    everything = [str(variant) for robot in split.robots for variant in catalogue(robot)]
    assert sorted(split.train + split.test) == sorted(everything)
    assert not set(split.train) & set(split.test)
    assert split.train
    assert split.test


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("category", CATEGORIES[:4])
def test_a_category_is_held_out_whole(robot: str, category: str) -> None:
    split = held_out(f"{robot}-{category}-v1")
    assert {Variant.parse(name).category for name in split.test} == {category}
    assert category not in {Variant.parse(name).category for name in split.train}


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_body_is_held_out_by_some_split(robot: str) -> None:
    limbs = [
        held_out(name)
        for name in held_out_names(robot)
        if name.split("-")[1] not in (*CATEGORIES, "extremes", "random")
    ]
    held = {Variant.parse(name).body for split in limbs for name in split.test}
    # Walker2d's feet share their friction, which belongs to neither leg.
    assert {variant.body for variant in catalogue(robot)} - held <= {"feet"}
    for split in limbs:
        bodies = {Variant.parse(name).body for name in split.test}
        assert not bodies & {Variant.parse(name).body for name in split.train}


def test_extremes_hold_out_the_largest_changes() -> None:
    split = held_out("hopper-extremes-v1")
    assert {Variant.parse(name).percent for name in split.test} == {-50, 50, 200}
    assert max(Variant.parse(n).percent for n in split.train if Variant.parse(n).category == "mass") == 100


def test_the_published_splits_stay_as_they_are() -> None:
    sizes = {name: (len(held_out(name).train), len(held_out(name).test)) for name in held_out_names()}
    assert len(sizes) == 38
    assert sizes["hopper-mass-v1"] == (17, 20)
    assert sizes["hopper-leg-v1"] == (28, 9)
    assert sizes["halfcheetah-bfoot-v1"] == (46, 7)
    assert sizes["walker2d-extremes-v1"] == (35, 29)
    assert sum(test for _, test in sizes.values()) == 372 + 7 + 11 + 13 + 154


@pytest.mark.parametrize(
    ("robot", "held_out_variants", "digest"),
    [
        ("hopper", 7, "820492d84bff4125"),
        ("halfcheetah", 11, "63cf26f5ec4a0694"),
        ("walker2d", 13, "a99b547d7b155390"),
    ],
)
def test_a_random_fifth_is_fixed_for_ever(robot: str, held_out_variants: int, digest: str) -> None:
    split = held_out(f"{robot}-random-v1")
    assert len(split.test) == held_out_variants == round(len(catalogue(robot)) / 5)
    text = "\n".join([*split.train, "", *split.test])
    assert hashlib.sha256(text.encode()).hexdigest().startswith(digest)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_robot_is_held_out_whole(robot: str) -> None:
    split = held_out(f"robots-{robot}-v1")
    assert split.test == tuple(str(variant) for variant in catalogue(robot))
    assert split.robots == (*(other for other in ROBOTS if other != robot), robot)
    assert split.name not in held_out_names(robot)


def test_a_split_of_ones_own() -> None:
    own = HeldOut(
        "mine",
        train=["hopper-base", Variant.parse("hopper-massinc_30_leggeom")],  # type: ignore[arg-type]
        test=("imujoco/walker2d-base-v0",),
    )
    assert own.train == ("hopper-base", "hopper-massinc_30_leggeom")
    assert own.test == ("walker2d-base",)
    assert own.robots == ("hopper", "walker2d")


@pytest.mark.parametrize(
    ("train", "test", "message"),
    [
        (["hopper-base"], ["hopper-base"], "hopper-base appears twice in train and test"),
        (["hopper-base", "imujoco/hopper-base-v0"], ["walker2d-base"], "hopper-base appears twice"),
        (["hopper-base"], [], "train and test each need at least one variant"),
        ("hopper-base", ["walker2d-base"], "expected a list of variant ids, not 'hopper-base'"),
        (None, ["walker2d-base"], "expected a list of variant ids, not None"),
        (
            ["hopper-bas"],
            ["walker2d-base"],
            r"malformed variant id 'hopper-bas' \(did you mean 'hopper-base'",
        ),
        ([None], ["walker2d-base"], "malformed variant id 'None'"),
    ],
)
def test_a_faulty_split_of_ones_own_is_refused(train: Any, test: Any, message: str) -> None:
    with pytest.raises(VariantError, match=message):
        HeldOut("mine", train, test)


def test_an_unknown_split_gets_the_nearest() -> None:
    with pytest.raises(
        VariantError, match=r"unknown split 'hopper-mass' \(did you mean 'hopper-mass-v1'\?\)"
    ):
        held_out("hopper-mass")
    with pytest.raises(VariantError, match="unknown split 'None'"):
        held_out(None)  # type: ignore[arg-type]
    with pytest.raises(VariantError, match="unknown robot"):
        held_out_names("crab")
