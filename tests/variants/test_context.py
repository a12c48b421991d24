"""Contexts: one order, one unit."""

from __future__ import annotations

import numpy as np
import pytest

from imujoco_minari.errors import VariantError
from imujoco_minari.variants import CATEGORIES, ROBOTS, Variant, bases, catalogue, specification
from imujoco_minari.variants.context import (
    changed_parameters,
    check_parameters,
    context,
    parameters,
    percents,
)


@pytest.mark.parametrize("robot", ROBOTS)
def test_parameters_come_in_the_order_of_categories_and_of_the_page(robot: str) -> None:
    names = parameters(robot)
    changes = specification(robot).categories
    assert len(names) == len(set(names))
    places = [
        (CATEGORIES.index(category), list(changes[category].bodies).index(body))
        for category, body in (name.split("/") for name in names)
    ]
    assert places == sorted(places)
    assert set(names) >= {f"{variant.category}/{variant.body}" for variant in catalogue(robot)}


def test_a_context_is_the_relative_change_of_each_parameter() -> None:
    names = parameters("hopper")
    for variant in catalogue("hopper"):
        vector = context(variant, names)
        (index,) = np.flatnonzero(vector)
        assert names[index] == f"{variant.category}/{variant.body}"
        assert 1 + vector[index] == pytest.approx(variant.changes[0].factor, rel=1e-15)
    for base in bases():
        assert not context(base, parameters(base.robot)).any()
        assert percents(base) == {}


def test_a_context_cannot_be_written_to() -> None:
    vector = context(Variant.parse("hopper-massdec_25_leggeom"), ["mass/leggeom"])
    with pytest.raises(ValueError, match="read-only"):
        vector[0] = 1.0


def test_changed_parameters_are_those_that_a_variant_changes() -> None:
    names = [
        "hopper-frictiondec_50_feet",
        "hopper-base",
        "hopper-massinc_50_leggeom",
        "hopper-massdec_25_torsogeom",
    ]
    variants = [Variant.parse(name) for name in names]
    assert changed_parameters(variants) == ("mass/torsogeom", "mass/leggeom", "friction/feet")
    assert changed_parameters([]) == ()


def test_a_change_that_a_context_would_hide_is_refused() -> None:
    with pytest.raises(VariantError, match="changes mass/leggeom, which is not a parameter of this context"):
        context(Variant.parse("hopper-massdec_25_leggeom"), ["mass/torsogeom"])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["mass/torsogem"], r"hopper has no parameter 'mass/torsogem' \(did you mean 'mass/torsogeom'"),
        (["mass/feet"], "valid: mass/torsogeom, "),
        (["mass/leggeom", "mass/leggeom"], "'mass/leggeom' stands twice"),
    ],
)
def test_bad_parameters_are_refused(names: list[str], message: str) -> None:
    with pytest.raises(VariantError, match=message):
        check_parameters("hopper", names)
    assert check_parameters("hopper", ["friction/feet", "mass/leggeom"]) == ("mass/leggeom", "friction/feet")
