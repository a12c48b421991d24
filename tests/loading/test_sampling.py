"""Samplers and batches: whole, seeded, masked, and never across an episode's end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from synthetic_arrays import BASE, LEG, RANDOM, synthetic
from torch.utils.data import DataLoader

from imujoco_minari.errors import ArgumentError, DatasetError, DatasetExistsError, VariantError
from imujoco_minari.exporting.torch import TransitionDataset, WindowDataset, as_is
from imujoco_minari.loading import (
    Arrays,
    Sampler,
    episode_batches,
    few_shot,
    preference_pairs,
    transition_batches,
    transition_samples,
    window_batches,
)
from imujoco_minari.loading.batches import gather_episodes, gather_windows, window_starts

LENGTHS = [5, 3, 7, 4]


def test_a_sample_is_whole_episodes_padded_with_zeros() -> None:
    data = synthetic(LENGTHS)
    shots = Sampler(data, portion=(0.0, 1.0), horizon=6).sample(4)
    assert shots.observations.shape == (4, 6, 3)
    assert shots.actions.shape == (4, 6, 2)
    assert shots.observations.dtype == shots.actions.dtype == np.float32
    assert shots.variant == BASE.variant
    for observations, actions, mask in zip(*shots[:3], strict=True):
        episode = int(observations[0, 0])
        steps = min(LENGTHS[episode], 6)
        assert mask.tolist() == [True] * steps + [False] * (6 - steps)
        assert observations[mask, 1].tolist() == list(range(steps))
        assert actions[mask, 0].tolist() == [-t for t in range(steps)]
        assert not observations[~mask].any()
        assert not actions[~mask].any()


def test_without_replacement_no_episode_comes_twice() -> None:
    shots = Sampler(synthetic([3] * 10), portion=(0.0, 1.0), horizon=3).sample(10)
    assert sorted(shots.observations[:, 0, 0].tolist()) == list(range(10))


def test_with_replacement_there_are_more_shots_than_episodes() -> None:
    assert len(Sampler(synthetic([3] * 2), portion=(0.0, 1.0), horizon=3).sample(9, replace=True).mask) == 9


def test_all_shots_of_a_sample_are_of_one_variant() -> None:
    data = synthetic([3] * 8, [BASE, LEG] * 4)
    sampler = Sampler(data, portion=(0.0, 1.0), horizon=3)
    assert len(sampler) == 2
    drawn = {
        (s.variant, frozenset((s.observations[:, 0, 0] % 2).tolist()))
        for s in (sampler.sample(3) for _ in range(20))
    }
    assert drawn == {(BASE.variant, frozenset({0.0})), (LEG.variant, frozenset({1.0}))}
    for idx in (1, np.int64(1), LEG.variant):
        shots = sampler.sample(3, idx=idx)
        assert shots.variant == LEG.variant
        assert set((shots.observations[:, 0, 0] % 2).tolist()) == {1.0}


def test_a_variant_of_several_tiers_is_drawn_from_all_of_them() -> None:
    data = synthetic([3] * 8, [BASE, RANDOM] * 4)
    sampler = Sampler(data, portion=(0.0, 1.0), horizon=3)
    drawn = [set((sampler.sample(3, idx=BASE.variant).observations[:, 0, 0] % 2).tolist()) for _ in range(20)]
    assert {0.0} in drawn
    assert {1.0} in drawn
    assert all(len(tier) == 1 for tier in drawn)


def test_the_id_of_a_variant_of_one_tier_draws_what_its_number_does() -> None:
    data = synthetic([3] * 8, [BASE, LEG] * 4)
    draws = [
        [Sampler(data, seed=4, horizon=3).sample(2, idx=idx).observations for _ in range(3)]
        for idx in (1, LEG.variant)
    ]
    np.testing.assert_array_equal(*draws)


def test_a_seed_repeats_the_draws() -> None:
    data = synthetic([3] * 20)
    one, same, other = (Sampler(data, seed=seed, horizon=3) for seed in (1, 1, 2))
    draws = [[s.sample(4).observations[:, 0, 0].tolist() for _ in range(3)] for s in (one, same, other)]
    assert draws[0] == draws[1] != draws[2]
    assert draws[0][0] != draws[0][1]


def test_sampling_leaves_the_global_generator_alone() -> None:
    np.random.seed(0)
    before = np.random.get_state()[1].tolist()  # type: ignore[index]
    Sampler(synthetic([3] * 4), horizon=3).sample(2)
    assert np.random.get_state()[1].tolist() == before  # type: ignore[index]


def test_train_and_test_samplers_share_no_episode() -> None:
    data = synthetic([3] * 12)
    train = Sampler(data, portion=(0.0, 0.75), horizon=3).sample(9)
    test = Sampler(data, portion=(0.75, 1.0), horizon=3).sample(3)
    assert not set(train.observations[:, 0, 0]) & set(test.observations[:, 0, 0])


def test_a_sampler_takes_dataset_ids(small_datasets: list[str]) -> None:
    sampler = Sampler(small_datasets, where={"category": "mass"}, horizon=50)
    assert [origin.variant for origin in sampler.arrays.table] == ["hopper-massdec_25_leggeom"]
    assert sampler.sample(3).observations.shape == (3, 50, 11)


def test_torch_samples_are_tensors() -> None:
    shots = Sampler(synthetic([3] * 4), horizon=3, torch=True).sample(2)
    assert all(isinstance(tensor, torch.Tensor) for tensor in shots[:3])
    assert shots.variant == BASE.variant
    assert shots.observations.dtype == torch.float32


def test_too_many_shots_are_refused_with_the_count() -> None:
    with pytest.raises(
        DatasetError, match="hopper-base has 3 episodes in this portion: 4 cannot be drawn without"
    ):
        Sampler(synthetic([3] * 4), horizon=3).sample(4)


@pytest.mark.parametrize("replace", [False, True])
def test_a_variant_without_episodes_in_the_portion_is_refused(replace: bool) -> None:
    sampler = Sampler(synthetic([3] * 9, [BASE] * 8 + [LEG]), portion=(0.0, 0.25), horizon=3)
    with pytest.raises(DatasetError, match=f"{LEG.variant} has 0 episodes in this portion"):
        sampler.sample(1, idx=LEG.variant, replace=replace)
    assert {sampler.sample(1, replace=replace).variant for _ in range(20)} == {BASE.variant}


@pytest.mark.parametrize("idx", [1, -1, "hopper-bas", 0.5, [0]])
def test_a_variant_that_is_not_there_is_refused(idx: Any) -> None:
    with pytest.raises(VariantError, match=r"no variant .*; valid: 0 to 0, or hopper-base$"):
        Sampler(synthetic([3] * 4), horizon=3).sample(2, idx=idx)


def test_arrays_are_not_filtered_again() -> None:
    with pytest.raises(DatasetError, match="pass `where` to arrays"):
        Sampler(synthetic([3]), where={"tier": "expert"})


@pytest.mark.parametrize("value", [0, -1, 1.5, "5", None])
def test_a_number_that_is_not_valid_is_named(value: Any) -> None:
    data = synthetic([3] * 4)
    calls: dict[str, list[Callable[[], object]]] = {
        "batch_size": [
            lambda: transition_batches(data, value),
            lambda: transition_samples(data, value),
            lambda: window_batches(data, 2, value),
            lambda: episode_batches(data, value),
        ],
        "length": [
            lambda: window_batches(data, value, 2),
            lambda: WindowDataset(data, value),
            lambda: preference_pairs(data, length=value),
        ],
        "horizon": [lambda: Sampler(data, horizon=value)],
        "tot_shots": [lambda: Sampler(data).sample(value)],
        "shots": [lambda: few_shot(data, shots=value)],
        "pairs": [lambda: preference_pairs(data, pairs=value, length=2)],
    }
    if value is not None:
        calls["queries"] = [lambda: few_shot(data, shots=1, queries=value)]
    if value != 0:
        calls["seed"] = [
            lambda: transition_batches(data, 2, seed=value),
            lambda: transition_samples(data, 2, seed=value),
            lambda: window_batches(data, 2, 2, seed=value),
            lambda: episode_batches(data, 2, seed=value),
            lambda: few_shot(data, shots=1, seed=value),
            lambda: preference_pairs(data, length=2, seed=value),
            lambda: data.portion(0.0, 0.5, seed=value),
        ]
    for name, functions in calls.items():
        for function in functions:
            with pytest.raises(ArgumentError, match=f"^{name} must be a whole number of at least [01], not "):
                function()


@pytest.mark.parametrize("data", [None, "imujoco/hopper-base-v0"])
def test_what_is_not_arrays_is_refused(data: Any) -> None:
    calls: list[Callable[[], object]] = [
        lambda: transition_batches(data, 2),
        lambda: transition_samples(data, 2),
        lambda: window_batches(data, 2, 2),
        lambda: episode_batches(data, 2),
        lambda: few_shot(data),
        lambda: preference_pairs(data),
        lambda: TransitionDataset(data),
        lambda: WindowDataset(data, 2),
    ]
    for function in calls:
        with pytest.raises(
            ArgumentError, match=f"expected the result of arrays.., not {type(data).__name__}"
        ):
            function()


def episodes_of(data: Arrays) -> set[float]:
    return set(data.observations[:, 0].tolist())


def test_support_and_query_partition_every_variant() -> None:
    data = synthetic([3] * 12, [BASE, LEG] * 6)
    support, query = few_shot(data, shots=2)
    np.testing.assert_array_equal(np.bincount(support.episode_variants), [2, 2])
    np.testing.assert_array_equal(np.bincount(query.episode_variants), [4, 4])
    assert not episodes_of(support) & episodes_of(query)
    assert few_shot(data, shots=2, queries=3).query.episodes == 6


def test_the_shots_of_a_variant_do_not_depend_on_the_others() -> None:
    both = few_shot(synthetic([3] * 12, [LEG] * 6 + [BASE] * 6), shots=2, seed=5).support
    alone = few_shot(synthetic([3] * 6, [LEG] * 6), shots=2, seed=5).support
    np.testing.assert_array_equal(both.observations[:6], alone.observations)


def test_another_seed_draws_other_shots() -> None:
    data = synthetic([3] * 12)
    draws = {tuple(sorted(episodes_of(few_shot(data, shots=3, seed=seed).support))) for seed in range(5)}
    assert len(draws) > 1


def test_too_few_episodes_are_refused_with_the_count() -> None:
    data = synthetic([3] * 4)
    with pytest.raises(DatasetError, match="hopper-base has 4 episodes; 3 shots and a query set need 5"):
        few_shot(data, shots=3, queries=2)
    with pytest.raises(DatasetError, match="need 5"):
        few_shot(data, shots=4)


def test_transition_batches_are_every_step_once() -> None:
    data = synthetic(LENGTHS)
    batches = list(transition_batches(data, 8, seed=1))
    assert [len(batch.rewards) for batch in batches] == [8, 8, 3]
    seen = np.concatenate([batch.observations for batch in batches])
    after = np.concatenate([batch.next_observations for batch in batches])
    assert sorted(map(tuple, seen)) == sorted(map(tuple, data.observations))
    np.testing.assert_array_equal(after[:, 1], seen[:, 1] + 1)
    assert not np.array_equal(seen, data.observations)


def test_transition_samples_are_drawn_without_end_and_with_replacement() -> None:
    data = synthetic(LENGTHS)
    batches = list(islice(transition_samples(data, 8, seed=1), 200))
    assert all(len(batch.rewards) == 8 for batch in batches)
    drawn = np.concatenate([batch.observations for batch in batches])
    steps, times = np.unique(drawn, axis=0, return_counts=True)
    assert len(steps) == len(data)
    # 1600 draws of 19 steps: 84 each, give or take five deviations of nine.
    assert 84 - 45 < times.min() <= times.max() < 84 + 45
    assert any(len(np.unique(batch.observations, axis=0)) < 8 for batch in batches)
    again, other = (next(transition_samples(data, 8, seed=seed)).observations for seed in (1, 2))
    np.testing.assert_array_equal(batches[0].observations, again)
    assert not np.array_equal(again, other)


def test_a_batch_may_be_written_to_without_harm_to_the_data_or_the_next() -> None:
    data = synthetic(LENGTHS)
    before = data.observations.copy()
    first, second = islice(transition_batches(data, 4), 2)
    kept = second.observations.copy()
    first.observations[:] = np.nan
    np.testing.assert_array_equal(data.observations, before)
    np.testing.assert_array_equal(second.observations, kept)


def test_mapped_arrays_make_the_same_batches(tmp_path: Path) -> None:
    data = synthetic(LENGTHS, truncated=[0, 1, 2, 3])
    data.save(tmp_path / "saved")
    mapped = Arrays.load(tmp_path / "saved", mmap=True)
    batches = zip(transition_batches(data, 8, seed=1), transition_batches(mapped, 8, seed=1), strict=True)
    for batch, same in batches:
        for column, mapped_column in zip(batch, same, strict=True):
            assert column.dtype == mapped_column.dtype
            np.testing.assert_array_equal(column, mapped_column)


def test_windows_stay_within_their_episode() -> None:
    data = synthetic(LENGTHS)
    batches = list(window_batches(data, 3, 4))
    windows = np.concatenate([batch.observations for batch in batches])
    assert len(windows) == 3 + 1 + 5 + 2
    assert (windows[:, :, 0] == windows[:, :1, 0]).all()
    assert (np.diff(windows[:, :, 1], axis=1) == 1).all()
    assert all(batch.mask.all() for batch in batches)


def test_padded_windows_begin_at_every_step() -> None:
    data = synthetic(LENGTHS, truncated=[0, 1, 2, 3])
    windows = gather_windows(data, window_starts(data, 4, padded=True), 4)
    assert len(windows.mask) == len(data)
    left = np.concatenate([np.arange(length, 0, -1) for length in LENGTHS])
    np.testing.assert_array_equal(windows.mask.sum(axis=1), np.minimum(left, 4))
    np.testing.assert_array_equal(windows.timesteps[windows.mask], windows.observations[windows.mask][:, 1])
    assert not windows.rewards[~windows.mask].any()


def test_episode_batches_are_padded_to_their_longest() -> None:
    (batch,) = episode_batches(synthetic(LENGTHS), 10)
    assert batch.mask.shape == (4, 7)
    assert sorted(batch.mask.sum(axis=1).tolist()) == sorted(LENGTHS)


@pytest.mark.parametrize("length", [1, 4, 7, 9])
def test_episodes_are_the_windows_from_their_starts(length: int) -> None:
    data = synthetic(LENGTHS, truncated=[0, 1, 2, 3])
    drawn = np.array([3, 0, 2, 2])
    by_windows = gather_windows(data, data.episode_starts[drawn], length)
    for column, expected in zip(gather_episodes(data, drawn, length), by_windows, strict=True):
        assert column.dtype == expected.dtype
        np.testing.assert_array_equal(column, expected)


def test_a_window_longer_than_every_episode_is_refused() -> None:
    with pytest.raises(DatasetError, match="no episode has 8 steps, the longest has 7"):
        window_starts(synthetic(LENGTHS), 8)


def test_a_loader_of_transitions_gives_every_step_once() -> None:
    data = synthetic(LENGTHS)
    loader = DataLoader(TransitionDataset(data), batch_size=8, shuffle=True, collate_fn=as_is)
    batches = list(loader)
    assert sum(len(batch["rewards"]) for batch in batches) == len(data)
    seen = torch.cat([batch["observations"] for batch in batches]).numpy()
    assert sorted(map(tuple, seen)) == sorted(map(tuple, data.observations))


def test_a_loader_works_without_our_collate() -> None:
    dataset = TransitionDataset(synthetic(LENGTHS))
    torch.testing.assert_close(dataset[4]["observations"], torch.tensor([0.0, 4.0, 0.5], dtype=torch.float64))
    assert dataset[4]["terminations"].item() is True


def test_a_loader_of_windows_gives_windows() -> None:
    dataset = WindowDataset(synthetic(LENGTHS), 3)
    assert len(dataset) == 11
    batch = next(iter(DataLoader(dataset, batch_size=11, collate_fn=as_is)))
    assert batch["observations"].shape == (11, 3, 3)
    assert dataset[3]["observations"][:, 0].tolist() == [1, 1, 1]
    assert len(WindowDataset(synthetic(LENGTHS), 3, padded=True)) == sum(LENGTHS)


def test_the_preferred_stretch_has_the_higher_return() -> None:
    data = synthetic([9] * 6, [BASE, LEG] * 3)
    chosen = preference_pairs(data, pairs=200, length=4, seed=2)
    returns = np.stack([chosen.first.rewards.sum(axis=1), chosen.second.rewards.sum(axis=1)], axis=1)
    np.testing.assert_allclose(chosen.scores, returns)
    np.testing.assert_array_equal(chosen.preferred, returns.argmax(axis=1))
    assert (returns[:, 0] != returns[:, 1]).all()
    np.testing.assert_array_equal(chosen.first.variant_index, chosen.second.variant_index)
    assert set(chosen.first.variant_index.tolist()) == {0, 1}


def test_a_variant_of_one_segment_is_in_no_pair() -> None:
    chosen = preference_pairs(synthetic([4, 9], [BASE, LEG]), pairs=50, length=4)
    assert set(chosen.first.variant_index.tolist()) == {1}
    with pytest.raises(DatasetError, match="all segments of hopper-base have the same score"):
        preference_pairs(synthetic([4, 4], [BASE, LEG]), pairs=50, length=4)


def test_ranked_tiers_decide_whatever_the_return() -> None:
    data = synthetic([6] * 4, [BASE, RANDOM] * 2)
    chosen = preference_pairs(data, pairs=50, length=3, tiers=("random", "expert"))
    better = np.where(chosen.preferred == 0, chosen.first.variant_index, chosen.second.variant_index)
    assert {data.table[place].tier for place in better} == {"random"}


def test_preferences_repeat_with_their_seed() -> None:
    data = synthetic([9] * 6)
    one, same, other = (preference_pairs(data, pairs=20, length=2, seed=seed).scores for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)


def test_preferences_are_saved_whole(tmp_path) -> None:
    chosen = preference_pairs(synthetic([9] * 6), pairs=20, length=2)
    chosen.save(tmp_path / "pairs.npz")
    with np.load(tmp_path / "pairs.npz") as saved:
        np.testing.assert_array_equal(saved["preferred"], chosen.preferred)
        np.testing.assert_array_equal(saved["second_observations"], chosen.second.observations)
        np.testing.assert_array_equal(saved["first_actions"], chosen.first.actions)
    with pytest.raises(DatasetExistsError, match=r"pairs\.npz already exists"):
        chosen.save(tmp_path / "pairs.npz")


def test_equal_rewards_prefer_nothing() -> None:
    data = synthetic([40] * 3)
    for dtype in (np.float64, np.float32):
        equal = replace(data, rewards=np.full(len(data), 0.1, dtype))
        with pytest.raises(DatasetError, match="all segments of hopper-base have the same score"):
            preference_pairs(equal, length=10)


def test_tiers_that_rank_nothing_are_refused() -> None:
    data = synthetic([2] * 3)
    with pytest.raises(
        DatasetError, match=r"the tier 'expert' \(did you mean 'experts'\?\), which is not in tiers"
    ):
        preference_pairs(data, length=2, tiers=["experts"])
    for tiers in ("expert", 3, [3]):
        with pytest.raises(ArgumentError, match="tiers must be a list from best to worst"):
            preference_pairs(data, length=2, tiers=tiers)  # type: ignore[arg-type]
