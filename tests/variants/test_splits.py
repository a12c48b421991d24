"""Splits: named sets of held-out variants."""

from __future__ import annotations

import pytest

from imujoco_minari.errors import CatalogueError, VariantError
from imujoco_minari.variants import CATEGORIES, ROBOTS, Variant, catalogue
from imujoco_minari.variants.splits import held_out, held_out_names, parse_splits

SPLIT = '[x-v1]\nrobot = "hopper"\ndescription = "d"\nheld_out = [{ category = ["mass"] }]\n'


@pytest.mark.parametrize("name", held_out_names())
def test_every_split_partitions_its_robots_variants(name: str) -> None:
    split = held_out(name)
    assert split.name == name
    assert name.startswith(f"{split.robot}-")
    assert name.endswith("-v1")
    assert set(split.train) | set(split.test) == {str(variant) for variant in catalogue(split.robot)}
    assert not set(split.train) & set(split.test)
    assert split.train
    assert split.test


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("category", CATEGORIES)
def test_a_category_is_held_out_whole(robot: str, category: str) -> None:
    split = held_out(f"{robot}-{category}-v1")
    assert {Variant.parse(name).category for name in split.test} == {category}
    assert category not in {Variant.parse(name).category for name in split.train}


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_body_is_held_out_by_some_split(robot: str) -> None:
    limbs = [
        held_out(name)
        for name in held_out_names(robot)
        if name.split("-")[1] not in (*CATEGORIES, "extremes")
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
    assert len(sizes) == 32
    assert sizes["hopper-mass-v1"] == (17, 20)
    assert sizes["hopper-leg-v1"] == (28, 9)
    assert sizes["halfcheetah-bfoot-v1"] == (46, 7)
    assert sizes["walker2d-extremes-v1"] == (35, 29)
    assert sum(test for _, test in sizes.values()) == 372


def test_an_unknown_split_gets_the_nearest() -> None:
    with pytest.raises(
        VariantError, match=r"unknown split 'hopper-mass' \(did you mean 'hopper-mass-v1'\?\)"
    ):
        held_out("hopper-mass")
    with pytest.raises(VariantError, match="unknown robot"):
        held_out_names("ant")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[", "not TOML"),
        (SPLIT.replace("description", "describe"), "must hold robot, description and held_out"),
        (SPLIT.replace("category", "categories"), "unknown rule 'categories'"),
        (SPLIT.replace('["mass"]', '["maß"]'), "no variant follows"),
        (SPLIT.replace("[{", "{").replace("}]", "}"), "must be a list of rules"),
    ],
)
def test_a_faulty_file_of_splits_is_named(text: str, message: str) -> None:
    with pytest.raises(CatalogueError, match=f"^bad.toml.*{message}"):
        parse_splits(text, "bad.toml")
