"""Which column is what, where episodes end, and what is simulated where a table lacks it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import original_archive
import pytest

from imujoco_minari.envs import environment_spec
from imujoco_minari.envs.external_mjcf import canonical_external_mjcf
from imujoco_minari.errors import DatasetError
from imujoco_minari.importing.columns import layout, read_table
from imujoco_minari.importing.physics import Physics
from imujoco_minari.importing.transitions import Cut, Transitions, cut
from imujoco_minari.variants import Variant, known_robots
from imujoco_minari.variants.original import OriginalVariant

HOPPER, CHEETAH = "hopper-massdec_25_leggeom", "halfcheetah-jointdec_25_bfoot"
Cutter = Callable[[str, Any], Cut]


@pytest.fixture
def cutter() -> Any:
    """Cuts a table, or transitions, as those of an original variant, whose simulator it closes."""
    made: list[Physics] = []

    def make(name: str, rows: Any) -> Cut:
        variant = OriginalVariant.parse(name)
        text = canonical_external_mjcf(original_archive.gym_xml(name), variant.robot, name)
        made.append(Physics(environment_spec(variant, text)))
        if not isinstance(rows, Transitions):
            rows, _, _ = read_table(rows, variant.robot, "t")
        return cut(rows, made[-1])

    yield make
    for each in made:
        each.__exit__()


@pytest.mark.parametrize("variant", [HOPPER, CHEETAH, "walker2d-massinc_50_torsogeom"])
@pytest.mark.parametrize(
    "columns",
    [
        ("reward", "done"),
        ("next_observation", "done"),
        ("reward", "next_observation", "done"),
        ("next_observation", "reward", "done"),
        ("reward", "next_observation", "terminated", "done"),
        ("done",),
    ],
)
def test_the_columns_are_detected(variant: str, columns: tuple[str, ...]) -> None:
    table = original_archive.table(variant, 2, columns)
    transitions, found, checks = read_table(table, variant.partition("-")[0], "t")
    assert str(found) == ",".join(("observation", "action", *columns))
    assert all(check.passed for check in checks)
    assert len(transitions) == len(table)
    assert (transitions.rewards is None) == ("reward" not in columns)
    assert transitions.observations.dtype == np.float64
    assert transitions.actions.dtype == np.float32


def test_float32_tables_are_detected_too() -> None:
    table = original_archive.table(HOPPER, 3, ("reward", "next_observation", "done")).astype(np.float32)
    assert str(read_table(table, "hopper", "t")[1]) == "observation,action,reward,next_observation,done"


@pytest.mark.parametrize("variant", [HOPPER, CHEETAH])
def test_truncations_are_not_taken_for_terminations(variant: str) -> None:
    """Both are 0 or 1, and 0 within episodes."""
    columns = ("reward", "next_observation", "truncated", "done")
    table = original_archive.table(variant, 3, columns)
    with pytest.raises(DatasetError, match=r"terminated marks the episodes that end early: no, [03] of 3"):
        read_table(table, variant.partition("-")[0], "t")


def test_a_column_that_is_no_reward_is_named_and_asked_for() -> None:
    table = original_archive.table(HOPPER, 4, ("odd", "done"))
    with pytest.raises(DatasetError) as raised:
        read_table(table, "hopper", "sac.npz")
    message = str(raised.value)
    assert "sac.npz: has 16 columns, 14 of them hopper's observation and action" in message
    assert "the reward follows the robot's formula: no" in message
    assert "--columns observation,action,reward,done" in message


def test_columns_of_no_known_number_are_asked_for() -> None:
    table = original_archive.table(HOPPER, 3, ("odd", "odd", "odd", "done"))
    with pytest.raises(DatasetError, match=r"the 4 others are not reward, next .*--columns"):
        read_table(table, "hopper", "t")
    transitions, found, _ = read_table(table, "hopper", "t", "observation, action, skip:3, done")
    assert str(found) == "observation,action,skip:3,done"
    assert transitions.rewards is None


def test_what_the_user_states_is_believed_and_its_checks_are_kept() -> None:
    table = original_archive.table(HOPPER, 4, ("odd", "done"))
    transitions, _, checks = read_table(table, "hopper", "t", "observation,action,reward,done")
    np.testing.assert_array_equal(transitions.rewards, table[:, 14])
    assert [check.passed for check in checks] == [True, True, False]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ("observation,action,rewards,done", "unknown column 'rewards' .did you mean 'reward'"),
        ("observation,action,reward", "the columns need done"),
        ("observation,action,reward,reward,done", "may repeat"),
        ("observation,action,skip:x,done", "skip:<how many>"),
        ("observation:3,action,done", "only skip takes a number"),
        ("observation,action,skip:4,done", "has 16 columns, but .* makes 19"),
        ("done,observation,action,reward", "the done column is 0 or 1: no, it holds 1.2"),
    ],
)
def test_columns_that_do_not_fit_are_refused(columns: str, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        read_table(original_archive.table(HOPPER, 2), "hopper", "t", columns)


def test_a_table_of_another_robot_or_of_nothing_is_refused() -> None:
    with pytest.raises(DatasetError, match="has 16 columns"):
        read_table(original_archive.table(HOPPER, 2), "walker2d", "t")
    with pytest.raises(DatasetError, match="not rows of columns"):
        read_table(np.zeros(5), "hopper", "t")
    table = original_archive.table(HOPPER, 2)
    table[3, 2] = np.nan
    with pytest.raises(DatasetError, match="not finite"):
        read_table(table, "hopper", "t", "observation,action,reward,done")
    table = original_archive.table(HOPPER, 2)
    table[:, 12] *= 3
    with pytest.raises(DatasetError, match="actions lie within -1 and 1: no, the largest is"):
        read_table(table, "hopper", "t")


def test_layouts_print_what_they_were_read_from() -> None:
    text = "observation,action,skip:2,reward,terminated,done"
    assert str(layout(text, "hopper")) == text
    assert layout(text, "hopper").width == 11 + 3 + 2 + 1 + 1 + 1


def test_the_final_observation_is_simulated_where_the_table_has_none(cutter: Cutter) -> None:
    whole = original_archive.table(HOPPER, 3, ("reward", "next_observation", "done"))
    expected = cutter(HOPPER, whole).episodes()
    found = cutter(HOPPER, np.delete(whole, np.s_[15:26], axis=1))
    assert found.simulate_final
    for mine, theirs in zip(found.episodes(), expected, strict=True):
        np.testing.assert_allclose(mine.observations, theirs.observations, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(mine.observations[:-1], theirs.observations[:-1])
        assert mine.terminations[-1]
        assert not mine.truncations.any()
        assert not mine.terminations[:-1].any()


def test_a_next_observation_that_is_the_next_reset_is_not_taken(cutter: Cutter) -> None:
    table = original_archive.table(HOPPER, 4, ("reward", "next_observation", "done"))
    ends = np.flatnonzero(table[:, -1])[:-1]
    table[ends, 15:26] = table[ends + 1, :11]
    found = cutter(HOPPER, table)
    assert found.simulate_final
    first = next(found.episodes())
    assert not np.allclose(first.observations[-1], table[ends[0] + 1, :11], atol=0.05)


def test_missing_rewards_are_simulated(cutter: Cutter) -> None:
    table = original_archive.table(CHEETAH, 1, ("reward", "done"))[:200]
    found = cutter(CHEETAH, np.delete(table, 23, axis=1))
    (episode,) = found.episodes()
    np.testing.assert_allclose(episode.rewards, table[:, 23], atol=1e-9)
    assert any("no rewards" in note for note in found.notes)


def test_episodes_that_only_the_time_limit_ends_are_found(cutter: Cutter) -> None:
    table = original_archive.table(CHEETAH, 2)
    table[:, -1] = 0
    found = cutter(CHEETAH, table)
    assert found.bounds == ((0, 1000), (1000, 2000))
    first = next(found.episodes())
    assert first.truncations[-1]
    assert not first.terminations.any()


def test_a_reset_that_no_flag_announces_is_found(cutter: Cutter) -> None:
    table = original_archive.table(HOPPER, 4)
    ends = np.flatnonzero(table[:, -1])
    # As in a loop of so many steps, which begins anew with no flag.
    table = np.delete(table, ends[1], axis=0)
    found = cutter(HOPPER, table)
    assert [stop - start for start, stop in found.bounds] == [
        ends[0] + 1,
        ends[1] - ends[0] - 1,
        ends[2] - ends[1],
        ends[3] - ends[2],
    ]
    assert "Episodes that end at a reset that the source does not mark: 1." in found.notes
    ended = [(e.terminations[-1], e.truncations[-1]) for e in found.episodes()]
    assert ended == [(True, False), (False, True), (True, False), (True, False)]


@pytest.mark.parametrize("robot", known_robots())
def test_a_reset_of_any_robot_is_found(robot: str) -> None:
    """In Ant and HalfCheetah, the velocities of a reset are normal, so some are larger than in the others."""
    spec = environment_spec(Variant(robot))
    env = gym.make(spec)
    env.action_space.seed(0)
    rows = []
    for seed in range(4):
        observation, _ = env.reset(seed=seed)
        for _ in range(9):
            action = env.action_space.sample()
            rows.append((observation, action))
            observation = env.step(action)[0]
    env.close()
    observations, actions = map(np.array, zip(*rows, strict=True))
    with Physics(spec) as physics:
        found = cut(Transitions(observations, actions, np.zeros(len(rows), bool)), physics)
    assert found.bounds == ((0, 9), (9, 18), (18, 27), (27, 36))


def test_flags_that_the_source_tells_apart_are_kept(cutter: Cutter) -> None:
    table = original_archive.table(HOPPER, 2)
    rows, _, _ = read_table(table, "hopper", "t")
    cuts = Transitions(
        rows.observations, rows.actions, rows.ends, np.zeros(len(table), bool), rows.ends, rows.rewards
    )
    for episode in cutter(HOPPER, cuts).episodes():
        assert not episode.terminations.any()
        assert episode.truncations[-1]


def test_steps_of_another_variant_are_farther_from_its_simulation(cutter: Cutter) -> None:
    table = original_archive.table(HOPPER, 5)
    near, far = (cutter(name, table).fidelity() for name in (HOPPER, "hopper-massinc_200_torsogeom"))
    assert near.rows == far.rows > 20
    assert near.position_max is not None
    assert far.position_median is not None
    assert near.reward_max is not None
    assert near.position_max < 1e-12 < 1e-5 < far.position_median
    assert near.reward_max < 1e-9
