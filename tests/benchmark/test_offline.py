"""The offline algorithms on a problem with a known answer, and one tiny cell of each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from actor_datasets import publish_actors
from synthetic_arrays import BASE

from imujoco_minari.benchmark.checks import changes
from imujoco_minari.benchmark.iql import Iql
from imujoco_minari.benchmark.offline import ALGORITHMS, OfflineGrid, run_offline
from imujoco_minari.benchmark.offline_cloning import Cloning
from imujoco_minari.benchmark.td3_bc import Td3Bc
from imujoco_minari.errors import BenchmarkError
from imujoco_minari.loading import Arrays

BEST = 0.6


@pytest.fixture(scope="module")
def bandit() -> Arrays:
    """Episodes of one step: uniform actions, and a reward that is highest for the action 0.6."""
    rng = np.random.default_rng(0)
    count = 1000
    observations = rng.normal(size=(count, 2)).astype(np.float32)
    actions = rng.uniform(-1.0, 1.0, (count, 1)).astype(np.float32)
    return Arrays(
        observations=observations,
        actions=actions,
        rewards=(-10.0 * (actions[:, 0] - BEST) ** 2).astype(np.float32),
        next_observations=observations,
        terminations=np.ones(count, bool),
        truncations=np.zeros(count, bool),
        variant_index=np.zeros(count, np.int32),
        episode_starts=np.arange(count),
        table=(BASE,),
    )


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
    from synthetic_arrays import synthetic

    data = synthetic([4] * 10)
    data.rewards[data.rows(7)] += 1.0
    data.actions[:] = np.where(data.observations[:, :1] == 7, 0.5, -0.5)
    assert mean_action(Cloning(0, (200,), best=0.1, batch=8), data) > 0.3


def test_one_tiny_cell_of_each_algorithm(
    monkeypatch: pytest.MonkeyPatch, small_datasets: list[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("imujoco_minari.benchmark.offline.TIERS", ("random",))
    monkeypatch.setattr("imujoco_minari.benchmark.offline.SHIFTED_TIER", "random")
    grid = OfflineGrid(robots=["hopper"], tiers=["random"], seeds=[0], updates=2, episodes=1)
    advanced: list[int] = []
    lines = run_offline(grid, tmp_path, on_cells=advanced.append)
    assert {line["method"] for line in lines} == set(ALGORITHMS)
    assert [len(line["results"]) for line in lines] == [5] * 4
    assert changes(lines) == []
    assert run_offline(grid, tmp_path, on_cells=advanced.append) == lines
    assert advanced == [0, 1, 1, 1, 1, 4]


def test_data_with_deterministic_actions_are_refused(root: Path, tmp_path: Path) -> None:
    publish_actors(["imujoco/hopper-base-medium-v0"], root, episodes=2)
    grid = OfflineGrid(methods=["bc"], robots=["hopper"], tiers=["medium"], seeds=[0], updates=2, episodes=1)
    with pytest.raises(BenchmarkError, match="publish hopper-base --tier medium --stochastic --force"):
        run_offline(grid, tmp_path)


def test_a_grid_names_the_valid_choices() -> None:
    with pytest.raises(BenchmarkError, match=r"no algorithm 'cql' here; valid: bc, bc-10%, td3\+bc, iql"):
        OfflineGrid(methods=["cql"])
    with pytest.raises(BenchmarkError, match="no tier 'expert' here; valid: medium, medium-replay"):
        OfflineGrid(tiers=["expert"])
