"""The interquartile mean and its bootstrap interval."""

from __future__ import annotations

import numpy as np
import pytest

from imujoco_minari.errors import ArgumentError
from imujoco_minari.policies.aggregates import bootstrap_interval, interquartile_mean


def test_the_interquartile_mean_ignores_a_quarter_on_each_side() -> None:
    assert interquartile_mean([-1000, 1, 2, 1000]) == 1.5
    assert interquartile_mean(np.array([[5.0, 1.0], [3.0, 100.0], [4.0, 2.0], [-9.0, 6.0]])) == 3.5
    assert interquartile_mean([7.0]) == interquartile_mean(7.0) == 7.0
    # Of 5 values, one is left out on each side.
    assert interquartile_mean([0, 1, 2, 3, 100]) == 2.0


def test_the_interval_holds_the_mean_of_a_known_distribution_19_times_in_20() -> None:
    rng = np.random.default_rng(0)
    held = 0
    for trial in range(200):
        low, high = bootstrap_interval(rng.normal(3.0, size=50), seed=trial)
        assert low < high
        held += low <= 3.0 <= high
    assert 180 <= held <= 198


def test_a_run_is_drawn_with_all_its_tasks() -> None:
    # All runs are equal, so every resample is the same.
    tasks = np.tile([0.0, 1.0, 2.0, 50.0], (10, 1))
    assert bootstrap_interval(tasks) == (1.5, 1.5)
    low, high = bootstrap_interval(tasks.ravel())
    assert low < 1.5 < high
    # Tasks that share the luck of a run say no more than one task.
    luck = np.arange(10.0)
    together = bootstrap_interval(np.tile(luck[:, None], (1, 20)))
    assert together == pytest.approx(bootstrap_interval(luck), abs=0.5)
    assert bootstrap_interval([1.0, 2.0, 9.0]) == bootstrap_interval([1.0, 2.0, 9.0])


def test_nothing_has_no_aggregate() -> None:
    for aggregate in (interquartile_mean, bootstrap_interval):
        with pytest.raises(ArgumentError, match="no values"):
            aggregate([])
