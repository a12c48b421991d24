"""Datasets that have at least a number of transitions."""

from __future__ import annotations

import minari
import pytest

from imujoco_minari.errors import ArgumentError, DatasetExistsError, VariantError
from imujoco_minari.publishing.counted import publish_transitions
from imujoco_minari.variants import Variant

VARIANT = Variant.parse("hopper-frictiondec_90_feet")
ID = "imujoco/hopper-frictiondec_90_feet-random-v0"


def test_a_dataset_has_just_enough_episodes() -> None:
    published = publish_transitions(VARIANT, 300, tier="random", seed=2)
    assert published.dataset_id == ID
    lengths = [len(episode) for episode in minari.load_dataset(ID).iterate_episodes()]
    assert sum(lengths[:-1]) < 300 <= sum(lengths) == published.steps
    # Fewer transitions of the same policy are a part of it; more need another dataset.
    assert not publish_transitions(str(VARIANT), 100, tier="random", seed=2).created
    with pytest.raises(DatasetExistsError, match=f"it has {len(lengths)} episodes"):
        publish_transitions(VARIANT, 600, tier="random", seed=2)
    with pytest.raises(DatasetExistsError, match="it has seed 2"):
        publish_transitions(VARIANT, 100, tier="random", seed=3)
    assert publish_transitions(VARIANT, 600, tier="random", seed=2, force=True).steps >= 600


def test_a_dataset_without_transitions_is_refused() -> None:
    with pytest.raises(ArgumentError, match="at least one transition, not 0"):
        publish_transitions(VARIANT, 0, tier="random")


def test_an_unknown_variant_is_refused() -> None:
    with pytest.raises(VariantError, match="jumper"):
        publish_transitions("jumper-base")
