"""The ids of whole sets: made, and parsed back."""

from __future__ import annotations

import pytest

from imujoco_minari.errors import VariantError
from imujoco_minari.variants import CATEGORIES, ROBOTS, catalogue
from imujoco_minari.variants.named_collections import NamedCollection


@pytest.mark.parametrize("tier", ["expert", "random", "medium-expert"])
@pytest.mark.parametrize("category", [None, *CATEGORIES[:4]])
@pytest.mark.parametrize("robot", ROBOTS)
def test_an_id_names_its_collection(robot: str, category: str | None, tier: str) -> None:
    collection = NamedCollection(robot, category, tier)
    assert NamedCollection.parse(collection.dataset_id) == collection
    assert collection.variants == catalogue(robot, category)
    assert collection.sources == [variant.dataset_id(tier) for variant in collection.variants]


def test_ids_are_regular() -> None:
    assert NamedCollection("hopper").dataset_id == "imujoco/hopper-all-v0"
    assert NamedCollection("hopper", "mass", "random").dataset_id == "imujoco/hopper-mass-random-v0"


@pytest.mark.parametrize(
    "dataset_id",
    [
        "imujoco/hopper-base-v0",
        "imujoco/hopper-mine-v0",
        "imujoco/crab-all-v0",
        "imujoco/hopper-all-v1",
        "imujoco/hopper-all-Random-v0",
        "imujoco/hopper-all-expert-v0",
        "imujoco/hopper-all--v0",
        "imujoco-original/hopper-all-v0",
        "hopper-all",
    ],
)
def test_other_ids_name_none(dataset_id: str) -> None:
    assert NamedCollection.parse(dataset_id) is None


def test_what_does_not_exist_is_refused() -> None:
    for wrong in (("crab",), ("hopper", "gravity"), ("hopper", None, "No Tier")):
        with pytest.raises(VariantError):
            NamedCollection(*wrong)
