"""The same variant, policy, seed and versions give the same content, however the work is shared out."""

from __future__ import annotations

from pathlib import Path

import pytest
from actor_datasets import random_weights
from safetensors.numpy import save_file

from imujoco_minari.publishing.publisher import publish_all, publish_recipe
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.variants import Variant, specification


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    """A SAC actor of random weights."""
    save_file(random_weights(*specification("hopper").sizes), tmp_path / "actor.safetensors")
    return tmp_path / "actor.safetensors"


@pytest.mark.parametrize("stochastic", [False, True])
def test_jobs_do_not_matter_nor_does_time(policy: Path, stochastic: bool) -> None:
    recipe = Recipe(
        Variant.parse("hopper-massdec_25_leggeom"), "mine", 9, seed=3, policy=policy, stochastic=stochastic
    )
    digests = [publish_recipe(recipe, jobs=jobs, force=True).content_sha256 for jobs in (1, 2, 1, 2)]
    assert len(set(digests)) == 1
    assert (
        publish_recipe(Recipe(recipe.variant, "mine", 9, 4, policy), force=True).content_sha256 != digests[0]
    )


def test_a_batch_makes_what_single_commands_make(policy: Path) -> None:
    variants = [Variant.parse(name) for name in ("hopper-base", "hopper-frictioninc_50_feet")]
    recipes = [Recipe(variant, "mine", 2, policy=policy) for variant in variants]
    batch = {outcome.dataset_id: outcome for outcome in publish_all(recipes, jobs=2)}
    assert not any(outcome.error for outcome in batch.values())
    for recipe in recipes:
        assert publish_recipe(recipe, force=True).content_sha256 == batch[recipe.dataset_id].content_sha256
