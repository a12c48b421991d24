"""Arrays: what is loaded is what is stored, selected, split, normalised and saved as asked."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest
from synthetic_arrays import BASE, LEG, RANDOM, synthetic

from imujoco_minari.errors import (
    ArgumentError,
    DatasetError,
    DatasetExistsError,
    DatasetIdError,
    DatasetNotFoundError,
    StorageError,
    VariantError,
)
from imujoco_minari.loading import STEP_ARRAYS, Arrays, Origin, Sampler, arrays, selection
from imujoco_minari.loading.statistics import measure
from imujoco_minari.publishing.combiner import combine_datasets
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


def _store(file: h5py.File, name: str, value: object) -> None:
    del file[name]
    file[name] = value


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


def test_a_share_of_episodes_that_each_have_a_variant_of_their_own_is_a_share_of_these_variants() -> None:
    drawn = [
        Origin(f"hopper-massinc_{p}p25_leggeom", "hopper", "mass", "leggeom", p + 0.25) for p in range(99)
    ]
    data = synthetic([2] * 99, drawn)
    train, test = (data.portion(*share, seed=3).origins for share in ((0.0, 0.75), (0.75, 1.0)))
    assert 60 < len(train) < 90
    assert sorted(train + test) == sorted(drawn)
    assert data.select(range(40)).portion(0.0, 0.75, seed=3).origins == [o for o in drawn[:40] if o in train]


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


@pytest.mark.parametrize("dtype", [None, np.float32])
def test_normalised_integers_are_floating_point_numbers(
    small_datasets: list[str], dtype: type | None
) -> None:
    with h5py.File(main_file(HOPPER), "a") as file:
        for number, group in enumerate(file.values()):
            _store(file, f"{group.name}/observations", np.full(group["observations"].shape, number))
    assert arrays(HOPPER).observations.dtype == np.int64
    data = arrays(HOPPER, normalize=True, dtype=dtype)
    assert data.observations.dtype == data.next_observations.dtype == (dtype or np.float64)
    assert data.statistics is not None
    expected = data.statistics.normalize(arrays(HOPPER).observations)
    assert len(np.unique(expected)) == 8
    np.testing.assert_allclose(data.observations, expected, rtol=1e-5, atol=1e-6)


def test_the_test_share_is_scaled_by_the_training_shares_statistics(small_datasets: list[str]) -> None:
    train = arrays(HOPPER, portion=(0.0, 0.75), normalize=True)
    assert train.statistics is not None
    test = arrays(HOPPER, portion=(0.75, 1.0), normalize=train.statistics)
    raw = arrays(HOPPER, portion=(0.75, 1.0))
    assert test.statistics is train.statistics
    np.testing.assert_allclose(test.observations, train.statistics.normalize(raw.observations))


def test_statistics_over_many_blocks_are_numpys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imujoco_minari.loading.statistics._BLOCK", 7)
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
    with pytest.raises(DatasetError, match="valid: 0 to 2"):
        synthetic([3, 2, 4]).select(numbers)


@pytest.mark.parametrize("numbers", [[[1, 2], [3]], [[1], [2]], [0.5], ["a"]])
def test_select_refuses_what_is_no_list_of_numbers(numbers: Any) -> None:
    with pytest.raises(ArgumentError, match="episodes must be a list of whole numbers, not "):
        synthetic([3, 2, 4]).select(numbers)


@pytest.mark.parametrize("mmap", [False, True])
def test_saved_arrays_load_equal(small_datasets: list[str], tmp_path: Path, mmap: bool) -> None:
    data = arrays(small_datasets, dtype=np.float32, normalize=True)
    data.save(tmp_path / "some" / "saved")
    again = Arrays.load(str(tmp_path / "some" / "saved"), mmap=mmap)
    assert_same(again, data)
    assert again.observations.dtype == np.float32
    assert isinstance(again.observations, np.memmap) == mmap
    assert data.statistics is not None
    assert again.statistics is not None
    np.testing.assert_array_equal(again.statistics.mean, data.statistics.mean)
    np.testing.assert_array_equal(again.statistics.std, data.statistics.std)
    assert [path.name for path in (tmp_path / "some").iterdir()] == ["saved"]


def test_changes_to_mapped_arrays_do_not_reach_the_files(tmp_path: Path) -> None:
    synthetic([3, 2]).save(tmp_path / "saved")
    Arrays.load(tmp_path / "saved", mmap=True).rewards[:] = 0
    assert_same(Arrays.load(tmp_path / "saved"), synthetic([3, 2]))


def test_saving_replaces_only_saved_arrays_and_only_by_force(tmp_path: Path) -> None:
    target = tmp_path / "saved"
    synthetic([3]).save(target)
    with pytest.raises(DatasetExistsError, match="saved"):
        synthetic([2]).save(target)
    assert len(Arrays.load(target)) == 3
    synthetic([2]).save(target, force=True)
    assert len(Arrays.load(target)) == 2
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    with pytest.raises(DatasetExistsError, match="other was not replaced: it is not an export"):
        synthetic([2]).save(tmp_path / "other", force=True)
    assert (tmp_path / "other" / "thesis.tex").exists()


def test_arrays_that_cannot_be_saved_leave_nothing(tmp_path: Path) -> None:
    data = synthetic([3])
    unpicklable = replace(data, rewards=data.rewards.astype(object))
    with pytest.raises(ValueError, match="allow_pickle"):
        unpicklable.save(tmp_path / "saved")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match=r"cannot write .*saved"):
        data.save(tmp_path / "file" / "saved")
    with pytest.raises(StorageError, match=r"cannot write .*: File name too long"):
        data.save(tmp_path / ("a" * 300))


def _write_object_array(folder: Path) -> None:
    np.save(folder / "rewards.npy", np.array([print] * 3, dtype=object), allow_pickle=True)


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda folder: shutil.rmtree(folder), "No such file"),
        (lambda folder: (folder / "arrays.json").unlink(), "No such file"),
        (lambda folder: (folder / "rewards.npy").unlink(), "No such file"),
        (lambda folder: (folder / "arrays.json").write_text("[]"), "list indices"),
        (lambda folder: (folder / "arrays.json").write_text("{"), "Expecting"),
        (lambda folder: (folder / "rewards.npy").write_bytes(b""), "EOF"),
        (lambda folder: np.save(folder / "rewards.npy", np.zeros(2)), "differ in length"),
        (_write_object_array, "Python objects"),
    ],
)
@pytest.mark.parametrize("mmap", [False, True])
def test_a_folder_without_saved_arrays_is_refused_in_one_line(
    tmp_path: Path, damage: Callable[[Path], object], reason: str, mmap: bool
) -> None:
    synthetic([3]).save(tmp_path / "saved")
    damage(tmp_path / "saved")
    with pytest.raises(
        DatasetError, match=f"saved is not a folder that Arrays.save.. wrote: .*{reason}"
    ) as error:
        Arrays.load(tmp_path / "saved", mmap=mmap)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ({"categories": "mass"}, r"unknown attribute 'categories' \(did you mean 'category'\?\)"),
        (
            {"category": "mas"},
            r"no episode has the category 'mas' \(did you mean 'mass'\?\); valid: base, ",
        ),
        ({"percent": "-25"}, "no episode has the percent '-25'.*; valid: -50, -25, 0"),
        ({"category": "mass", "percent": -50}, "no episode has all of category 'mass', percent -50"),
        ({"percent": [[-25]]}, r"percent must be a value or a list of values, not \[\[-25\]\]"),
        ({"percent": []}, "percent must be a value or a list of values"),
        (3, "where must map attributes to values, as in .*, not 3"),
        ([], "where must map attributes to values"),
    ],
)
def test_a_filter_that_keeps_nothing_says_what_there_is(
    small_datasets: list[str], where: dict[str, object], message: str
) -> None:
    with pytest.raises(VariantError, match=message):
        arrays(small_datasets, where=where)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        *(
            ({"portion": portion}, "portion must be two increasing numbers from 0 to 1")
            for portion in [(0.5, 0.5), (-0.1, 0.5), (0.5, 1.1), (0.75, 0.25), "x", "01", 0.5, None, (0, "a")]
        ),
        *(({"seed": seed}, "seed must be a whole number of at least 0") for seed in [-1, 0.5, "x", None]),
        *(({"dtype": dtype}, "dtype must be a floating-point type") for dtype in ["x", 3, "int8", object]),
        *(({"normalize": value}, "normalize must be True, False or Statistics") for value in [None, 3, "x"]),
    ],
)
def test_an_argument_that_is_not_valid_is_named(
    small_datasets: list[str], argument: dict[str, object], message: str
) -> None:
    with pytest.raises(ArgumentError, match=message) as error:
        arrays(HOPPER, **argument)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)
    if "portion" in argument or "seed" in argument:
        with pytest.raises(ArgumentError, match=message):
            Sampler(arrays(HOPPER), **argument)  # type: ignore[arg-type]


def test_an_error_names_some_of_many_drawn_variants(
    small_datasets: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(selection, "SHOWN_VALUES", 2)
    with pytest.raises(VariantError, match=r"valid: -50, -25 and 1 more$"):
        arrays(small_datasets, where={"percent": 7})
    with pytest.raises(VariantError, match=r"or hopper-base, hopper-massdec_25_leggeom and 1 more$"):
        Sampler(small_datasets).sample(1, idx="hopper")


def test_an_empty_portion_is_refused(small_datasets: list[str]) -> None:
    with pytest.raises(DatasetError, match="no episode falls into"):
        arrays(LEGS, portion=(0.0, 0.1))


def test_statistics_of_another_robot_are_refused(small_datasets: list[str]) -> None:
    with pytest.raises(DatasetError, match=r"statistics of \(17,\) do not fit"):
        arrays(HOPPER, normalize=measure(np.zeros((2, 17))))


@pytest.mark.parametrize("load", [arrays, Sampler])
@pytest.mark.parametrize(
    ("datasets", "message"),
    [
        ([], "no dataset was given"),
        (None, "a dataset is a Minari dataset or its id, not NoneType"),
        (3, "not int"),
        ([None], "not NoneType"),
        ("hopper", "malformed dataset id 'hopper'"),
        ("hopper-base-random", r"did you mean 'imujoco/hopper-base-random-v0'\?"),
    ],
)
def test_what_is_not_a_dataset_is_refused(load: Callable[[Any], object], datasets: Any, message: str) -> None:
    with pytest.raises((ArgumentError, DatasetIdError), match=message):
        load(datasets)


def test_a_dataset_that_was_deleted_is_named(small_datasets: list[str]) -> None:
    dataset = minari.load_dataset(HOPPER)
    shutil.rmtree(minari_root.dataset_folder(HOPPER))
    for deleted in (HOPPER, dataset):
        with pytest.raises(DatasetNotFoundError, match=f"{HOPPER} is not in the Minari root, at .*publish"):
            arrays([LEGS, deleted])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: f.pop("episode_1/rewards"), "episode 1 has no array rewards"),
        (lambda f: f.move("episode_3/actions", "episode_2/actions"), "episode 2: actions have shape"),
        (lambda f: f.pop("episode_3"), "has no episode 3"),
        (
            lambda f: _store(f, "episode_1/observations", f["episode_1/observations"][()].T),
            "episode 1: observations have shape",
        ),
        (lambda f: _store(f, "episode_0/rewards", 1.0), "episode 0: rewards are not an array"),
        (lambda f: _store(f, "episode_1/rewards", 1.0), "episode 1: rewards are not an array"),
        (lambda f: _store(f, "episode_0/rewards", np.zeros((5, 1))), "rewards must be numbers at each step"),
        (lambda f: _store(f, "episode_0/actions", np.zeros(5)), "actions must be vectors of numbers"),
        (
            lambda f: _store(f, "episode_0/actions", np.full((5, 3), b"x")),
            "actions must be vectors of numbers",
        ),
        (lambda f: _store(f, "episode_0/rewards", h5py.Empty("f8")), "episode 0: rewards are not an array"),
        (lambda f: f.attrs.__setitem__("percent", "many"), "a percent that is not a number"),
        (lambda f: f.attrs.__setitem__("body", [1, 2]), "attributes that are not text"),
    ],
)
def test_a_broken_dataset_is_named(small_datasets: list[str], damage: object, message: str) -> None:
    with h5py.File(main_file(HOPPER), "a") as file:
        if "actions" in message:
            del file["episode_2/actions"]
        damage(file)  # type: ignore[operator]
    with pytest.raises(DatasetError, match=message):
        arrays(HOPPER)


def _set_robot(dataset_id: str, robot: str) -> None:
    with h5py.File(main_file(dataset_id), "a") as file:
        file.attrs["robot"] = robot


def test_robots_do_not_mix_though_their_shapes_are_equal(small_datasets: list[str]) -> None:
    _set_robot(LEGS, "walker2d")
    message = rf"arrays hold one robot, .*several: hopper \({HOPPER}\), walker2d \({LEGS}\)$"
    with pytest.raises(DatasetError, match=message):
        arrays(small_datasets)
    assert arrays(small_datasets, where={"robot": "walker2d"}).episodes == 4


def test_an_unknown_robot_does_not_mix_with_a_known_one(small_datasets: list[str]) -> None:
    _set_robot(LEGS, "")
    with pytest.raises(DatasetError, match=rf"hopper \({HOPPER}\), unknown \({LEGS}\)$"):
        arrays([HOPPER, LEGS])


def test_datasets_of_different_shapes_do_not_mix(small_datasets: list[str]) -> None:
    with h5py.File(main_file(LEGS), "a") as file:
        for group in file.values():
            wide = np.zeros((len(group["observations"]), 17))
            del group["observations"]
            group["observations"] = wide
    with pytest.raises(DatasetError, match="observations have shape"):
        arrays([HOPPER, LEGS])


def test_a_foreign_dataset_has_an_unknown_origin(small_datasets: list[str]) -> None:
    with h5py.File(main_file(HOPPER), "a") as file:
        for item in (file, *file.values()):
            for name in set(selection.ATTRIBUTES) & set(item.attrs):
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
        DatasetError, match=r"hopper-some-v0: .*cannot be read.*hopper-massdec_25_leggeom-random-v0"
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
