"""Arrays: what is loaded is what is stored, selected, split, normalised and cached as asked."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import h5py
import minari
import numpy as np
import pytest
from synthetic_arrays import BASE, LEG, RANDOM, synthetic

from imujoco_minari.errors import DatasetError, DatasetNotFoundError, StorageError, VariantError
from imujoco_minari.loading import array_cache, selection
from imujoco_minari.loading.load import STEP_ARRAYS, Arrays, arrays, measure
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.storage import minari_root

HOPPER, LEGS, FEET = (
    "imujoco/hopper-base-random-v0",
    "imujoco/hopper-massdec_25_leggeom-random-v0",
    "imujoco/hopper-frictiondec_50_feet-random-v0",
)


def assert_same(one: Arrays, other: Arrays) -> None:
    for name in (*STEP_ARRAYS, "episode_starts"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert one.table == other.table


def main_file(dataset_id: str) -> Path:
    return minari_root.dataset_folder(dataset_id) / "data" / "main_data.hdf5"


def test_every_number_is_minaris(small_datasets: list[str]) -> None:
    episodes = [e for name in small_datasets for e in minari.load_dataset(name).iterate_episodes()]
    data = arrays(small_datasets)
    assert data.episodes == len(episodes) == 16
    expected = {
        "observations": [e.observations[:-1] for e in episodes],
        "next_observations": [e.observations[1:] for e in episodes],
        "actions": [e.actions for e in episodes],
        "rewards": [e.rewards for e in episodes],
        "terminations": [e.terminations for e in episodes],
        "truncations": [e.truncations for e in episodes],
    }
    for name, parts in expected.items():
        stored = np.concatenate(parts)
        np.testing.assert_array_equal(getattr(data, name), stored, err_msg=name)
        assert getattr(data, name).dtype == stored.dtype
        assert getattr(data, name).flags.c_contiguous
    np.testing.assert_array_equal(data.episode_lengths, [len(e.rewards) for e in episodes])
    np.testing.assert_allclose(data.returns, [e.rewards.sum() for e in episodes])


def test_the_table_names_each_rows_variant(small_datasets: list[str]) -> None:
    data = arrays(small_datasets)
    assert [origin.variant for origin in data.table] == [
        "hopper-base",
        "hopper-massdec_25_leggeom",
        "hopper-frictiondec_50_feet",
    ]
    assert [(o.category, o.body, o.percent) for o in data.table] == [
        ("base", "", 0),
        ("mass", "leggeom", -25),
        ("friction", "feet", -50),
    ]
    assert {origin.tier for origin in data.table} == {"random"}
    np.testing.assert_array_equal(data.episode_variants, [0] * 8 + [1] * 4 + [2] * 4)
    assert len(data.variant_index) == len(data)


@pytest.mark.parametrize("link", [False, True])
def test_a_collection_is_its_datasets(small_datasets: list[str], link: bool) -> None:
    combine_datasets(small_datasets, "imujoco/hopper-some-v0", link=link)
    assert_same(arrays("imujoco/hopper-some-v0"), arrays(small_datasets))


def test_a_filtered_view_is_that_view(small_datasets: list[str]) -> None:
    dataset = minari.load_dataset(HOPPER)
    view = dataset.filter_episodes(lambda episode: episode.id in (1, 3))
    assert_same(arrays(view), arrays(HOPPER).select([1, 3]))


@pytest.mark.parametrize(
    ("where", "episodes"),
    [
        ({"category": "mass"}, 4),
        ({"percent": [-25, -50]}, 8),
        ({"variant": "hopper-base"}, 8),
        ({"body": ("leggeom", "feet"), "percent": -50}, 4),
        ({"tier": "random", "robot": "hopper"}, 16),
        ({"percent": range(-30, -20)}, 4),
    ],
)
def test_where_keeps_the_episodes_that_match(
    small_datasets: list[str], where: dict[str, object], episodes: int
) -> None:
    assert arrays(small_datasets, where=where).episodes == episodes


def test_portions_are_disjoint_and_together_all(small_datasets: list[str]) -> None:
    everything = arrays(small_datasets)
    train = arrays(small_datasets, portion=(0.0, 0.75), seed=3)
    test = arrays(small_datasets, portion=(0.75, 1.0), seed=3)
    np.testing.assert_array_equal(np.bincount(train.episode_variants), [6, 3, 3])
    np.testing.assert_array_equal(np.bincount(test.episode_variants), [2, 1, 1])
    rows = np.concatenate((train.observations, test.observations))
    assert {tuple(row) for row in rows} == {tuple(row) for row in everything.observations}


def test_the_share_of_a_variant_does_not_depend_on_the_others(small_datasets: list[str]) -> None:
    combine_datasets(small_datasets, "imujoco/hopper-some-v0")
    alone = arrays(LEGS, portion=(0.0, 0.5), seed=1)
    among = arrays("imujoco/hopper-some-v0", portion=(0.0, 0.5), seed=1, where={"category": "mass"})
    assert_same(alone, among)
    chosen_later = arrays(small_datasets).portion(0.0, 0.5, seed=1).select([4, 5])
    np.testing.assert_array_equal(alone.observations, chosen_later.observations)


def test_another_seed_is_another_share(small_datasets: list[str]) -> None:
    shares = {arrays(HOPPER, portion=(0.0, 0.5), seed=seed).observations.tobytes() for seed in range(4)}
    assert len(shares) > 1


def test_float32_rounds_observations_and_rewards(small_datasets: list[str]) -> None:
    exact, rounded = arrays(HOPPER), arrays(HOPPER, dtype=np.float32)
    for name in ("observations", "next_observations", "rewards"):
        np.testing.assert_array_equal(getattr(rounded, name), getattr(exact, name).astype(np.float32))
        assert getattr(rounded, name).dtype == np.float32


@pytest.mark.parametrize("dtype", [None, np.float32])
def test_normalised_observations_have_mean_0_and_deviation_1(
    small_datasets: list[str], dtype: type | None
) -> None:
    exact = arrays(small_datasets)
    data = arrays(small_datasets, normalize=True, dtype=dtype)
    assert data.statistics is not None
    np.testing.assert_allclose(data.observations.mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(data.observations.std(axis=0), 1, atol=1e-4)
    np.testing.assert_allclose(data.statistics.mean, exact.observations.mean(axis=0), rtol=1e-4, atol=1e-6)
    for name in ("observations", "next_observations"):
        restored = data.statistics.denormalize(getattr(data, name))
        np.testing.assert_allclose(restored, getattr(exact, name), rtol=1e-4, atol=1e-5)


def test_the_test_share_is_scaled_by_the_training_shares_statistics(small_datasets: list[str]) -> None:
    train = arrays(HOPPER, portion=(0.0, 0.75), normalize=True)
    assert train.statistics is not None
    test = arrays(HOPPER, portion=(0.75, 1.0), normalize=train.statistics)
    raw = arrays(HOPPER, portion=(0.75, 1.0))
    assert test.statistics is train.statistics
    np.testing.assert_allclose(test.observations, train.statistics.normalize(raw.observations))


def test_statistics_over_many_blocks_are_numpys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imujoco_minari.loading.load._BLOCK", 7)
    values = np.random.default_rng(0).normal(3.0, 2.0, (100, 4))
    values[:, 3] = 5.0
    statistics = measure(values)
    np.testing.assert_allclose(statistics.mean, values.mean(axis=0))
    np.testing.assert_allclose(statistics.std[:3], values[:, :3].std(axis=0))
    assert statistics.std[3] == 1.0


def test_a_trajectory_holds_its_final_observation() -> None:
    data = synthetic([3, 2], truncated=[1])
    first, second = data.trajectories()
    assert first.observations[:, 1].tolist() == [0, 1, 2, 3]
    assert second.observations[:, 1].tolist() == [0, 1, 2]
    assert (first.terminated, first.truncated) == (True, False)
    assert (second.terminated, second.truncated) == (False, True)
    assert data.trajectory(-1).rewards.tolist() == [1, 2]


def test_select_keeps_whole_episodes_in_the_order_given() -> None:
    data = synthetic([3, 2, 4], [BASE, LEG, BASE])
    chosen = data.select([2, 1])
    assert chosen.observations[:, 0].tolist() == [2, 2, 2, 2, 1, 1]
    assert chosen.episode_lengths.tolist() == [4, 2]
    assert [origin.variant for origin in chosen.origins] == [BASE.variant, LEG.variant]


@pytest.mark.parametrize("numbers", [[], [3], [-1]])
def test_select_refuses_what_is_no_episode(numbers: list[int]) -> None:
    with pytest.raises(DatasetError, match="numbered 0 to 2"):
        synthetic([3, 2, 4]).select(numbers)


def test_a_cached_load_is_mapped_and_equal(small_datasets: list[str], home: Path) -> None:
    first = arrays(small_datasets, dtype=np.float32, normalize=True, cache=True)
    entries = list(array_cache.cache_folder().iterdir())
    assert entries[0].is_relative_to(home)
    again = arrays(small_datasets, dtype=np.float32, normalize=True, cache=True)
    assert isinstance(again.observations, np.memmap)
    assert_same(again, arrays(small_datasets, dtype=np.float32, normalize=True))
    assert_same(again, first)
    assert again.statistics is not None
    np.testing.assert_array_equal(
        again.statistics.mean, measure(arrays(small_datasets, dtype=np.float32).observations).mean
    )
    assert list(array_cache.cache_folder().iterdir()) == entries


def test_changing_mapped_arrays_leaves_the_cache_alone(small_datasets: list[str]) -> None:
    arrays(HOPPER, cache=True).rewards[:] = 0
    assert_same(arrays(HOPPER, cache=True), arrays(HOPPER))


def test_whatever_changes_the_result_has_an_entry_of_its_own(small_datasets: list[str]) -> None:
    options = [
        {},
        {"dtype": np.float32},
        {"portion": (0.0, 0.5)},
        {"portion": (0.0, 0.5), "seed": 1},
        {"where": {"tier": "random"}},
        {"where": {"percent": np.arange(1)}},
        {"normalize": True},
        {"normalize": measure(np.arange(22.0).reshape(2, 11))},
    ]
    for option in options:
        assert_same(arrays(HOPPER, cache=True, **option), arrays(HOPPER, **option))
    assert len(list(array_cache.cache_folder().iterdir())) == len(options)


def test_datasets_of_equal_content_keep_their_own_table(small_datasets: list[str]) -> None:
    identity = "imujoco/hopper-massinc_0_leggeom-random-v0"
    publish("hopper-massinc_0_leggeom", tier="random", episodes=8)
    before, after = arrays(HOPPER, cache=True), arrays(identity, cache=True)
    np.testing.assert_array_equal(before.observations, after.observations)
    assert [data.table[0].variant for data in (before, after)] == ["hopper-base", "hopper-massinc_0_leggeom"]


def test_a_dataset_without_a_digest_is_known_by_its_file(small_datasets: list[str]) -> None:
    with h5py.File(main_file(HOPPER), "a") as file:
        del file.attrs["content_sha256"]
    arrays(HOPPER, cache=True)
    with h5py.File(main_file(HOPPER), "a") as file:
        file["episode_0/rewards"][0] = 123.0
    assert arrays(HOPPER, cache=True).rewards[0] == 123.0


def test_a_linked_collection_is_known_by_what_it_links_to(small_datasets: list[str]) -> None:
    combine_datasets([HOPPER, LEGS], "imujoco/hopper-some-v0", link=True)
    source = selection.sources("imujoco/hopper-some-v0")
    before = array_cache.key(source, {}, (0.0, 1.0), 0, None, False)
    with h5py.File(main_file(LEGS), "a") as file:
        file.attrs["content_sha256"] = "another"
    assert array_cache.key(source, {}, (0.0, 1.0), 0, None, False) != before


def test_a_damaged_entry_is_made_anew(small_datasets: list[str]) -> None:
    arrays(HOPPER, cache=True)
    (entry,) = array_cache.cache_folder().iterdir()
    (entry / "rewards.npy").write_bytes(b"")
    assert_same(arrays(HOPPER, cache=True), arrays(HOPPER))
    assert isinstance(arrays(HOPPER, cache=True).rewards, np.memmap)


def test_a_cache_that_cannot_be_written_is_said(
    small_datasets: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("IMUJOCO_HOME", str(tmp_path / "file"))
    with pytest.raises(StorageError, match="cannot write to the cache"):
        arrays(HOPPER, cache=True)


def test_an_unknown_dataset_is_named(small_datasets: list[str]) -> None:
    with pytest.raises(DatasetNotFoundError, match="imujoco/hopper-none-v0 is not in the Minari root"):
        arrays([HOPPER, "imujoco/hopper-none-v0"])


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ({"categories": "mass"}, r"unknown attribute 'categories' \(did you mean 'category'\?\)"),
        (
            {"category": "mas"},
            r"no episode has the category 'mas' \(did you mean 'mass'\?\); there are: base, ",
        ),
        ({"percent": "-25"}, "no episode has the percent '-25'.*; there are: -50, -25, 0"),
        ({"category": "mass", "percent": -50}, "no episode has all of category 'mass', percent -50"),
    ],
)
def test_a_filter_that_keeps_nothing_says_what_there_is(
    small_datasets: list[str], where: dict[str, object], message: str
) -> None:
    with pytest.raises(VariantError, match=message):
        arrays(small_datasets, where=where)


@pytest.mark.parametrize("portion", [(0.5, 0.5), (-0.1, 0.5), (0.5, 1.1), (0.75, 0.25)])
def test_a_portion_that_is_none_is_refused(small_datasets: list[str], portion: tuple[float, float]) -> None:
    with pytest.raises(DatasetError, match="portion must lie in 0 to 1"):
        arrays(HOPPER, portion=portion)


def test_an_empty_portion_is_refused(small_datasets: list[str]) -> None:
    with pytest.raises(DatasetError, match="no episode falls into"):
        arrays(LEGS, portion=(0.0, 0.1))


def test_a_negative_seed_is_refused(small_datasets: list[str]) -> None:
    with pytest.raises(DatasetError, match="a seed is not negative"):
        arrays(LEGS, portion=(0.0, 0.5), seed=-1)


def test_statistics_of_another_robot_are_refused(small_datasets: list[str]) -> None:
    with pytest.raises(DatasetError, match=r"statistics of \(17,\) do not fit"):
        arrays(HOPPER, normalize=measure(np.zeros((2, 17))))


def test_nothing_is_no_dataset() -> None:
    with pytest.raises(DatasetError, match="no dataset was given"):
        arrays([])
    with pytest.raises(DatasetError, match="not int"):
        arrays(3)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: f.pop("episode_1/rewards"), "episode 1 has no array rewards"),
        (lambda f: f.move("episode_3/actions", "episode_2/actions"), "episode 2: actions are of shape"),
        (lambda f: f.pop("episode_3"), "has no episode 3"),
    ],
    ids=["array", "shape", "episode"],
)
def test_a_broken_dataset_is_named(small_datasets: list[str], damage: object, message: str) -> None:
    with h5py.File(main_file(HOPPER), "a") as file:
        if "actions" in message:
            del file["episode_2/actions"]
        damage(file)  # type: ignore[operator]
    with pytest.raises(DatasetError, match=message):
        arrays(HOPPER)


def test_datasets_of_different_robots_do_not_mix(small_datasets: list[str]) -> None:
    with h5py.File(main_file(LEGS), "a") as file:
        for group in file.values():
            wide = np.zeros((len(group["observations"]), 17))
            del group["observations"]
            group["observations"] = wide
    with pytest.raises(DatasetError, match="observations are of shape"):
        arrays([HOPPER, LEGS])


def test_a_foreign_dataset_has_an_unknown_origin(small_datasets: list[str]) -> None:
    with h5py.File(main_file(HOPPER), "a") as file:
        for item in (file, *file.values()):
            for name in selection.ATTRIBUTES:
                del item.attrs[name]
    data = arrays(HOPPER)
    assert data.table == (selection.Origin(),)
    assert data.episodes == 8


def test_arrays_of_other_layouts_are_read_too(small_datasets: list[str]) -> None:
    before = arrays(HOPPER)
    with h5py.File(main_file(HOPPER), "a") as file:
        group = file["episode_0"]
        for name in ("observations", "actions", "rewards", "terminations"):
            array = group[name][()]
            del group[name]
            if name == "observations":
                group.create_dataset(name, data=array, compression="gzip")
            else:
                group.create_dataset(name, data=array.astype(">f8") if name == "rewards" else array)
    assert_same(arrays(HOPPER), before)


def test_the_stated_metadata_is_not_trusted_for_sizes(small_datasets: list[str]) -> None:
    path = main_file(HOPPER).parent / "metadata.json"
    metadata = json.loads(path.read_text())
    path.write_text(json.dumps(metadata | {"total_steps": 10**12, "total_episodes": 2}))
    assert arrays(HOPPER).episodes == 8


def test_tiers_of_one_variant_are_told_apart() -> None:
    data = synthetic([2] * 8, [BASE, RANDOM] * 4)
    half = data.portion(0.0, 0.5)
    assert sorted(origin.tier for origin in half.origins) == ["expert"] * 2 + ["random"] * 2


def test_a_link_to_what_is_gone_is_named(small_datasets: list[str]) -> None:
    combine_datasets([HOPPER, LEGS], "imujoco/hopper-some-v0", link=True)
    main_file(LEGS).unlink()
    with pytest.raises(
        DatasetError, match=r"hopper-some-v0: .*hopper-massdec_25_leggeom-random-v0.*cannot be read"
    ):
        arrays("imujoco/hopper-some-v0")


def test_loading_and_exporting_need_neither_minari_nor_mujoco(
    small_datasets: list[str], tmp_path: Path
) -> None:
    # Other libraries' environments, with their old pins, have neither.
    code = (
        "import sys\n"
        "for name in ('minari', 'mujoco', 'torch', 'stable_baselines3', 'jax'): sys.modules[name] = None\n"
        "import imujoco_minari.exporting.adapters\n"
        "from imujoco_minari import Sampler, export, held_out\n"
        f"export({HOPPER!r}, 'd4rl', {str(tmp_path / 'x.hdf5')!r})\n"
        f"Sampler({HOPPER!r}).sample(2)\n"
        "held_out('hopper-mass-v1')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "x.hdf5").exists()
