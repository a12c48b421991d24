"""The offline algorithms on a problem with a known answer, and one tiny cell of each."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from actor_datasets import publish_actors
from synthetic_arrays import synthetic

from imujoco_minari.benchmark.checks import changes
from imujoco_minari.benchmark.cloning import Cloning
from imujoco_minari.benchmark.critics import Iql, Td3Bc
from imujoco_minari.benchmark.lines import read_lines
from imujoco_minari.benchmark.methods import find_method
from imujoco_minari.benchmark.offline import (
    ACROSS_ALGORITHMS,
    ACROSS_FILE,
    ALGORITHMS,
    FILE,
    OfflineGrid,
    Told,
    run_offline,
)
from imujoco_minari.benchmark.scores import offline_scores
from imujoco_minari.errors import BenchmarkError
from imujoco_minari.loading import Arrays, Origin
from imujoco_minari.variants import HeldOut, Variant

BEST = 0.6


@pytest.fixture(scope="module")
def bandit() -> Arrays:
    """Episodes of one step: uniform actions, and a reward that is highest for the action 0.6."""
    rng = np.random.default_rng(0)
    count = 1000
    observations = rng.normal(size=(count, 2)).astype(np.float32)
    actions = rng.uniform(-1.0, 1.0, (count, 1)).astype(np.float32)
    return replace(
        synthetic([1] * count),
        observations=observations,
        actions=actions,
        rewards=(-10.0 * (actions[:, 0] - BEST) ** 2).astype(np.float32),
        next_observations=observations,
    )


def bodies(percents: list[int]) -> Arrays:
    """One episode of Hopper for each mass of the leg; all actions are half the sign of the change."""
    rng, rows = np.random.default_rng(0), 100 * len(percents)
    observations = rng.normal(size=(rows, 11)).astype(np.float32)
    sign = np.repeat(np.sign(percents), 100)
    names = [f"hopper-mass{'inc' if percent > 0 else 'dec'}_{abs(percent)}_leggeom" for percent in percents]
    origins = [
        Origin(name, "hopper", "mass", "leggeom", percent, "random")
        for name, percent in zip(names, percents, strict=True)
    ]
    actions = np.repeat(0.5 * sign[:, None], 3, axis=1).astype(np.float32)
    data = synthetic([100] * len(percents), origins)
    return replace(data, observations=observations, actions=actions, next_observations=observations)


def mean_action(algorithm: Cloning | Td3Bc | Iql, data: Arrays) -> float:
    actor = algorithm.train(data)[max(algorithm.checkpoints)]
    return float(np.mean([actor.act(row, np.random.default_rng(0))[0] for row in data.observations[:100]]))


def test_each_algorithm_finds_what_it_should_in_a_bandit(bandit: Arrays) -> None:
    """Cloning imitates the mean action, 0; the best tenth of the data lies around the best action."""
    assert abs(mean_action(Cloning(0, (300,), batch=64), bandit)) < 0.1
    assert abs(mean_action(Cloning(0, (300,), best=0.1, batch=64), bandit) - BEST) < 0.1
    assert mean_action(Td3Bc(0, (300, 600), rate=1e-3, batch=64), bandit) > 0.3
    assert abs(mean_action(Iql(0, (300, 600), rate=1e-3, batch=64), bandit) - BEST) < 0.15


def test_the_best_episodes_are_chosen_by_their_returns() -> None:
    """Of ten equal episodes, a tenth is one, and the highest return makes it."""
    data = synthetic([4] * 10)
    data.rewards[data.rows(7)] += 1.0
    data.actions[:] = np.where(data.observations[:, :1] == 7, 0.5, -0.5)
    assert mean_action(Cloning(0, (200,), best=0.1, batch=8), data) > 0.3


def test_one_tiny_cell_of_each_algorithm(
    monkeypatch: pytest.MonkeyPatch, small_datasets: list[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("imujoco_minari.benchmark.offline.ALL_TIERS", ("random",))
    monkeypatch.setattr("imujoco_minari.benchmark.offline.SHIFTED_TIER", "random")
    grid = OfflineGrid(robots=["hopper"], tiers=["random"], seeds=[0], updates=2, episodes=1)
    advanced: list[int] = []
    lines = run_offline(grid, tmp_path, on_cells=advanced.append)
    assert {line["method"] for line in lines} == set(ALGORITHMS)
    assert [len(line["results"]) for line in lines] == [5] * 4
    assert changes(lines) == []
    assert run_offline(grid, tmp_path, on_cells=advanced.append) == lines
    assert advanced == [0, 1, 1, 1, 1, 4]


@pytest.mark.usefixtures("small_datasets")
def test_one_tiny_cell_of_each_algorithm_across_variants(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("imujoco_minari.benchmark.offline.SHIFTED_TIER", "random")
    split = HeldOut(
        "mine", train=["hopper-base", "hopper-massdec_25_leggeom"], test=["hopper-frictiondec_50_feet"]
    )
    monkeypatch.setattr("imujoco_minari.benchmark.offline.held_out", lambda name: split)
    grid = OfflineGrid(ACROSS_ALGORITHMS, ["hopper"], ["random"], [0], updates=2, episodes=1, across=True)
    lines = run_offline(grid, tmp_path)
    assert [list(line["results"]) for line in lines] == [["hopper-frictiondec_50_feet"]] * 4
    assert [line["settings"].get("told") for line in lines] == [None, None, True, True]
    assert changes(lines) == []
    assert read_lines(tmp_path / ACROSS_FILE) == lines
    scores = offline_scores(lines)
    assert {score.group for score in scores} == {"hopper-random-v1"}
    assert {score.category for score in scores} == {"shifted", "friction"}


def test_new_experts_change_the_references_and_nothing_is_computed_again(
    monkeypatch: pytest.MonkeyPatch, small_datasets: list[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("imujoco_minari.benchmark.offline.ALL_TIERS", ("random",))
    monkeypatch.setattr("imujoco_minari.benchmark.offline.SHIFTED_TIER", "random")
    grid = OfflineGrid({"bc": Cloning}, ["hopper"], ["random"], [0], updates=2, episodes=1)
    (before,) = run_offline(grid, tmp_path)
    monkeypatch.setattr("imujoco_minari.benchmark.offline.policies_sha256", lambda variants: "new")
    monkeypatch.setattr("imujoco_minari.benchmark.offline.references", lambda variant: [0.0, 1.0])
    monkeypatch.setattr("imujoco_minari.benchmark.offline._run_cell", pytest.fail)
    (after,) = run_offline(grid, tmp_path)
    new = {"policies_sha256": "new", "references": {name: [0.0, 1.0] for name in before["references"]}}
    assert after == {**before, **new}
    assert run_offline(grid, tmp_path) == [after]
    assert read_lines(tmp_path / FILE) == [before, after]


def test_the_policy_is_evaluated_at_the_numbers_of_the_protocol() -> None:
    assert OfflineGrid().checkpoints() == [25_000, 50_000, 100_000, 250_000]
    assert OfflineGrid(updates=100_000).checkpoints() == [25_000, 50_000, 100_000]
    assert OfflineGrid(updates=30).checkpoints() == [30]


def test_a_policy_that_is_told_the_variant_acts_by_it() -> None:
    """The action is the sign of the variant's change, which no observation shows."""
    data = bodies([-50, 50])
    policy = Told(partial(Cloning, rate=1e-3, batch=64), 0, (300,)).train(data)[300]
    for percent in (-50, 50):
        variant = Variant.parse(f"hopper-mass{'inc' if percent > 0 else 'dec'}_50_leggeom")
        action = policy.fold(variant).act(data.observations[0], np.random.default_rng(0))
        np.testing.assert_allclose(action, 0.5 * np.sign(percent), atol=0.1)


def test_data_with_deterministic_actions_are_refused(root: Path, tmp_path: Path) -> None:
    publish_actors(["imujoco/hopper-base-medium-v0"], root, episodes=2)
    grid = OfflineGrid(
        methods={"bc": Cloning}, robots=["hopper"], tiers=["medium"], seeds=[0], updates=2, episodes=1
    )
    with pytest.raises(BenchmarkError, match="publish hopper-base --tier medium --stochastic --force"):
        run_offline(grid, tmp_path)


def test_a_grid_names_the_valid_choices() -> None:
    with pytest.raises(BenchmarkError, match=r"no method 'cql'.*; valid: bc, bc-10%, td3\+bc, iql, or <mod"):
        find_method("cql", ALGORITHMS)
    with pytest.raises(BenchmarkError, match="no tier 'expert' here; valid: medium, medium-replay"):
        OfflineGrid(tiers=["expert"])
