"""Ranges: what a seed draws from them, and which are refused."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from imujoco_minari.errors import ImujocoError
from imujoco_minari.variants import Ranges
from imujoco_minari.variants.context import percents

TWO = {"friction/feet": (-50, 50), "mass/torsogeom": (-50, 100)}


def drawn(ranges: Ranges, count: int) -> dict[str, list[float]]:
    rows = [percents(ranges.draw(seed)) for seed in range(count)]
    return {name: [row[name] for row in rows] for name in ranges.parameters}


@pytest.mark.parametrize("distribution", ["uniform", "log-uniform"])
def test_draws_have_the_stated_distribution(distribution: str) -> None:
    ranges = Ranges("hopper", TWO, distribution)
    columns = drawn(ranges, 2000)
    shares = []
    for name, values in columns.items():
        low, high = ranges.ranges[name]
        assert all(low <= value <= high and round(value, 2) == value for value in values)
        ends, numbers = np.array([low, high]), np.array(values)
        if distribution == "log-uniform":
            ends, numbers = np.log1p(ends / 100), np.log1p(numbers / 100)
        share = np.sort((numbers - ends[0]) / (ends[1] - ends[0]))
        # The Kolmogorov-Smirnov statistic of 2000 draws exceeds 0.04 once in 300 sets.
        assert np.abs(share - np.arange(2000) / 2000).max() < 0.04
        shares.append((numbers - ends[0]) / (ends[1] - ends[0]))
    assert abs(np.corrcoef(*shares)[0, 1]) < 0.08


def test_a_draw_depends_on_the_seed_only() -> None:
    ranges = Ranges("hopper", TWO)
    other = pickle.loads(pickle.dumps(Ranges("hopper", dict(reversed(TWO.items())))))
    assert other == ranges
    assert ranges.parameters == ("mass/torsogeom", "friction/feet")
    assert [ranges.draw(seed) for seed in (0, 1, 2**63)] == [other.draw(seed) for seed in (0, 1, 2**63)]
    assert len({ranges.draw(seed) for seed in range(50)}) == 50


def test_a_draw_is_not_correlated_with_the_initial_state() -> None:
    ranges = Ranges("hopper", {"mass/torsogeom": (-50, 50)})
    first = [
        np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed))).random() for seed in range(500)
    ]
    assert abs(np.corrcoef(drawn(ranges, 500)["mass/torsogeom"], first)[0, 1]) < 0.15


def test_one_parameter_draws_a_simple_variant() -> None:
    ranges = Ranges("walker2d", {"joint/legjoint": [-50, -50]})
    assert str(ranges.draw(3)) == "walker2d-jointdec_50_legjoint"
    assert ranges.dataset_id("random") == "imujoco/walker2d-randomised-random-v0"
    named = Ranges("walker2d", {"joint/legjoint": [-50, -50]}, name="stiff")
    assert named.dataset_id() == "imujoco/walker2d-stiff-v0"


def test_numbers_of_numpy_are_numbers() -> None:
    whole = Ranges("hopper", {name: np.array(bounds) for name, bounds in TWO.items()})  # type: ignore[misc]
    assert whole == Ranges("hopper", TWO)
    assert Ranges("hopper", {name: list(map(np.int16, bounds)) for name, bounds in TWO.items()}) == whole
    assert {type(bound) for bounds in whole.ranges.values() for bound in bounds} == {int}


def test_a_group_is_drawn_as_one() -> None:
    variant = Ranges("walker2d", {"joint/thighjoints": (-50, 0)}).draw(0)
    assert len(variant.changes) == 1
    assert variant.mjcf_names == ("thigh_joint", "thigh_left_joint")
    with pytest.raises(ImujocoError, match="the joint of thigh_joint is changed twice"):
        Ranges("walker2d", {"joint/thighjoints": (-50, 0), "joint/thighjoint": (-50, 0)})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("hoper", TWO), r"unknown robot 'hoper' \(did you mean 'hopper'"),
        (("hopper", {}), "no ranges are given; valid: parameter -> percents"),
        (("hopper", None), "no ranges are given; valid: parameter -> percents"),
        (("hopper", {"mass/torsogem": (0, 1)}), "hopper has no parameter 'mass/torsogem'"),
        (("hopper", {"mass/torsogeom": (5, -5)}), r"range of mass/torsogeom is \(5, -5\); valid: the lowest"),
        (("hopper", {"mass/torsogeom": 5}), "range of mass/torsogeom is 5; valid"),
        (("hopper", {"mass/torsogeom": (5,)}), "valid: the lowest and the highest percent"),
        (
            ("hopper", {"mass/torsogeom": np.zeros((2, 2))}),
            r"is \[\[0.0, 0.0\], \[0.0, 0.0\]\]; valid: the low",
        ),
        (("hopper", {"mass/torsogeom": (float("nan"), 5)}), "valid: the lowest and the highest percent"),
        (("hopper", {"mass/torsogeom": ("a", "b")}), "valid: the lowest and the highest percent"),
        (
            ("hopper", {"mass/torsogeom": (-100, 5)}),
            "the range of mass/torsogeom: percent -100 leaves nothing",
        ),
        (("hopper", {"mass/torsogeom": (0.001, 5)}), "with at most two decimals, not 0.001"),
        (
            ("hopper", {"joint/legjoint": (-5, 5)}),
            "range of joint/legjoint: the range of leg_joint can only shrink",
        ),
        (("hopper", TWO, "log_uniform"), r"unknown distribution 'log_uniform' \(did you mean 'log-uniform'"),
        (
            ("hopper", TWO, "uniform", "mass"),
            "name of the ranges is 'mass'; valid: a lower-case word, but not",
        ),
        (("hopper", TWO, "uniform", "a-b"), "name of the ranges is 'a-b'"),
    ],
)
def test_bad_ranges_are_refused(arguments: tuple, message: str) -> None:
    with pytest.raises(ImujocoError, match=message):
        Ranges(*arguments)
