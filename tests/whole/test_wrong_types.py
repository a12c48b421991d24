"""Every public function names an argument of a wrong type in one line."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest

import imujoco_minari as im
from imujoco_minari.errors import ImujocoError
from imujoco_minari.loading import Arrays
from imujoco_minari.policies import read_actor
from imujoco_minari.publishing.publisher import publish_all
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.variants import HeldOut, held_out_names

HOPPER, LEGS = "imujoco/hopper-base-random-v0", "imujoco/hopper-massdec_25_leggeom-random-v0"


def publish(variant: Any = "hopper-base", tier: Any = "random", **options: Any) -> object:
    return im.publish(variant, tier=tier, **options)


CALLS: dict[str, tuple[Callable[[], object], str]] = {
    "publish episodes": (lambda: publish(episodes="5"), "episodes must be .* not '5'"),
    "publish tier": (lambda: publish(tier=None), "malformed tier 'None'"),
    "publish jobs": (lambda: publish(jobs=0), "jobs must be .* not 0"),
    "publish seed": (lambda: publish(seed=1.5), "seed must be .* not 1.5"),
    "publish variant": (lambda: publish(None), "a variant id is text, not NoneType"),
    "publish policy": (lambda: publish(policy=3), "which int does not have"),
    "publish_all": (lambda: list(publish_all([None])), "takes recipes"),  # type: ignore[list-item]
    "publish_all jobs": (lambda: list(publish_all([], jobs=0)), "jobs must be"),
    "Recipe": (lambda: Recipe("hopper-base"), "needs a Variant or Ranges, not str"),  # type: ignore[arg-type]
    "combine nothing": (lambda: im.combine_datasets(None, "me/b-v0"), "a list .* not NoneType"),  # type: ignore[arg-type]
    "combine one id": (lambda: im.combine_datasets(HOPPER, "me/b-v0"), "a list of datasets"),
    "combine None": (lambda: im.combine_datasets([None], "me/b-v0"), "or its id, not NoneType"),  # type: ignore[list-item]
    "combine id": (lambda: im.combine_datasets([HOPPER], None), "malformed dataset id"),  # type: ignore[arg-type]
    "load_dataset": (lambda: im.load_dataset(None), "malformed dataset id"),  # type: ignore[arg-type]
    "arrays": (lambda: im.arrays(None), "not NoneType"),  # type: ignore[arg-type]
    "arrays where": (lambda: im.arrays(HOPPER, where="x"), "where must map"),  # type: ignore[arg-type]
    "select": (lambda: im.arrays(HOPPER).select("x"), "whole numbers, not 'x'"),
    "select None": (lambda: im.arrays(HOPPER).select(None), "not None"),  # type: ignore[arg-type]
    "save": (lambda: im.arrays(HOPPER).save(None), "a path is text .* not None"),  # type: ignore[arg-type]
    "load": (lambda: Arrays.load(None), "a path is text"),  # type: ignore[arg-type]
    "Sampler": (lambda: im.Sampler(HOPPER, horizon="x"), "horizon must be"),  # type: ignore[arg-type]
    "few_shot": (lambda: im.few_shot(None), "expected the result of arrays"),  # type: ignore[arg-type]
    "verify": (lambda: im.verify(None), "malformed dataset id"),  # type: ignore[arg-type]
    "verify jobs": (lambda: im.verify(HOPPER, jobs=0), "jobs must be"),
    "make": (lambda: im.make(None), "not NoneType"),  # type: ignore[arg-type]
    "register": (lambda: im.register(3), "not int"),  # type: ignore[arg-type]
    "canonical_mjcf": (lambda: im.canonical_mjcf(None), "not NoneType"),  # type: ignore[arg-type]
    "load_policy": (lambda: im.load_policy(None), "not NoneType"),  # type: ignore[arg-type]
    "load_policy tier": (lambda: im.load_policy("hopper-base", tier=None), "the tier None"),  # type: ignore[arg-type]
    "read_actor": (lambda: read_actor(None), "not by NoneType"),  # type: ignore[arg-type]
    "catalogue": (lambda: im.catalogue([]), "unknown robot"),  # type: ignore[arg-type]
    "catalogue category": (lambda: im.catalogue("hopper", 3), "unknown category '3'"),  # type: ignore[arg-type]
    "held_out": (lambda: im.held_out([]), "unknown split"),  # type: ignore[arg-type]
    "held_out_names": (lambda: held_out_names(3), "unknown robot"),  # type: ignore[arg-type]
    "HeldOut": (lambda: HeldOut("m", None, ("hopper-base",)), "a list of variant ids"),  # type: ignore[arg-type]
    "load_catalogue": (lambda: im.load_catalogue(None), "a path is text"),  # type: ignore[arg-type]
    "evaluate": (lambda: im.evaluate("hopper-base", np.zeros), "the policy"),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_wrong_type_is_named_in_one_line(name: str, small_datasets: list[str]) -> None:
    call, message = CALLS[name]
    with pytest.raises(ImujocoError, match=message) as error:
        call()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("call", [im.arrays, im.verify, lambda name: im.combine_datasets([name], "me/b-v0")])
def test_a_dataset_that_was_deleted_is_named(
    call: Callable[[Any], object], small_datasets: list[str], root: Path
) -> None:
    dataset = minari.load_dataset(LEGS)
    shutil.rmtree(root / LEGS)
    for given in (LEGS, dataset) if call is not im.verify else (LEGS,):
        with pytest.raises(ImujocoError, match=LEGS) as error:
            call(given)
        assert "\n" not in str(error.value)


def test_ids_are_taken_where_variants_are() -> None:
    variant = im.Variant.parse("hopper-base")
    assert im.canonical_mjcf("hopper-base") == im.canonical_mjcf(variant)
    assert im.Variant.parse(variant) is variant
