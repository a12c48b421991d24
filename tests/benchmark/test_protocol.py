"""How demonstrations are drawn. Observation t of episode e is (e, t, 0.5) in these arrays."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_arrays import synthetic

from imujoco_minari.benchmark.protocol import BUDGETS, QUERY_EPISODES, Budget, draw_demonstrations
from imujoco_minari.errors import BenchmarkError

DATA = synthetic([30] * 12 + [4] * 3)


def steps(data: object) -> set[tuple[float, float]]:
    return {(row[0], row[1]) for row in data.observations.tolist()}  # type: ignore[attr-defined]


def test_windows_are_of_different_episodes_and_the_first_is_a_start() -> None:
    shown, query = draw_demonstrations(DATA, Budget(4, 5), seed=0)
    rows = shown.observations
    assert shown.episodes == 4
    assert rows[0, 1] == 0
    for window in range(4):
        own = rows[shown.rows(window)]
        assert len(set(own[:, 0])) == 1
        assert (np.diff(own[:, 1]) == 1).all()
    assert len({episode for episode, _ in steps(shown)}) == 4
    assert query.episodes == QUERY_EPISODES
    assert {episode for episode, _ in steps(query)}.isdisjoint({episode for episode, _ in steps(shown)})


def test_a_smaller_budget_is_part_of_a_larger_and_seeds_differ() -> None:
    few, many = (steps(draw_demonstrations(DATA, Budget(count, 5), seed=1)[0]) for count in (2, 5))
    assert few < many
    assert few != steps(draw_demonstrations(DATA, Budget(2, 5), seed=2)[0])


def test_whole_episodes_and_episodes_shorter_than_a_window() -> None:
    shown, _ = draw_demonstrations(DATA, Budget(3), seed=0)
    assert set(shown.episode_lengths) <= {30, 4}
    cut, query = draw_demonstrations(DATA, Budget(14, 5), seed=0)
    assert sorted(set(cut.episode_lengths)) == [4, 5]
    assert query.episodes == 1


def test_budgets_are_read_as_they_are_written() -> None:
    assert [Budget.parse(str(budget)) for budget in BUDGETS] == list(BUDGETS)
    for text in ("", "x", "0x5", "5x0", "all", "5xsome", "-1x100", f"{'9' * 5000}x1"):
        with pytest.raises(BenchmarkError, match="no budget"):
            Budget.parse(text)


def test_too_few_episodes_are_refused() -> None:
    with pytest.raises(
        BenchmarkError, match=r"hopper-base has 2 episodes; the budget 2x100 needs 3: 2 to demonstrate"
    ):
        draw_demonstrations(synthetic([5, 5]), Budget(2, 100), seed=0)
