"""Normalised scores: 0 is the random policy's return and 1 the expert's, without any dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest

from imujoco_minari import normalized_score, publish
from imujoco_minari.errors import ArgumentError, ImujocoError, PolicyNotFoundError, VariantError
from imujoco_minari.policies import expert_record
from imujoco_minari.variants import Variant

BASE, LEG = "hopper-base", "hopper-massdec_25_leggeom"


def references(variant: str) -> tuple[float, float]:
    record = expert_record(Variant.parse(variant))
    return record["random"]["return_mean"], record["evaluation"]["return_mean"]


def test_the_references_score_0_and_1(root: Path) -> None:
    low, high = references(BASE)
    assert normalized_score(BASE, [low, high, (low + high) / 2]).tolist() == pytest.approx([0, 1, 0.5])
    assert normalized_score(Variant.parse(BASE), high) == pytest.approx(1)
    assert normalized_score(BASE, [[low], [high]]).shape == (2, 1)
    assert not root.exists()


def test_a_collection_is_normalised_by_the_variant_of_each_episode() -> None:
    (_, high), (other_low, other_high) = references(BASE), references(LEG)
    assert high != other_high
    scores = normalized_score([BASE, LEG, Variant.parse(LEG)], [high, other_high, other_low])
    assert scores.tolist() == pytest.approx([1, 1, 0])
    assert normalized_score([], []).shape == (0,)
    assert normalized_score(np.array([BASE, LEG]), [high, other_high]).tolist() == pytest.approx([1, 1])
    assert normalized_score(np.array(BASE), high) == pytest.approx(1)


def test_minari_computes_the_same_from_a_published_dataset() -> None:
    dataset = minari.load_dataset(publish(BASE, tier="random", episodes=2).dataset_id)
    returns = np.array([-5.0, 100.0, 3000.0])
    np.testing.assert_allclose(
        normalized_score(BASE, returns), minari.get_normalized_score(dataset, returns), rtol=1e-12
    )


@pytest.mark.parametrize(
    ("variant", "returns", "error", "message"),
    [
        ("hopper", [1.0], VariantError, "malformed variant id 'hopper'"),
        ("humanoid-base", [1.0], PolicyNotFoundError, "no expert"),
        ([BASE, LEG], [1.0], ArgumentError, r"the returns have the shape \(1,\)"),
        ([BASE, LEG], 1.0, ArgumentError, "one variant for each return"),
        (None, [1.0], ArgumentError, "one variant for each return"),
        (np.array([[BASE]]), [1.0], VariantError, "a variant id is text, not list"),
        (BASE, "many", ArgumentError, "returns must be numbers, not 'many'"),
        (BASE, None, ArgumentError, "returns must be numbers, not None"),
    ],
)
def test_a_wrong_argument_is_named(
    variant: Any, returns: Any, error: type[ImujocoError], message: str
) -> None:
    with pytest.raises(error, match=message):
        normalized_score(variant, returns)
