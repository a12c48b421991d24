"""Exports: every number where the format has it, whole targets only, and what a format loses."""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from synthetic_arrays import BASE, LEG, RANDOM, synthetic

from imujoco_minari.cli.app import run
from imujoco_minari.errors import DatasetError, DatasetExistsError, DependencyError, StorageError
from imujoco_minari.exporting import FORMATS, default_target, export, lerobot, rlds
from imujoco_minari.exporting.rlds import example, record
from imujoco_minari.loading import Arrays, Origin, arrays
from imujoco_minari.storage.targets import new_target


@pytest.fixture
def data() -> Arrays:
    """Four episodes of two variants; the second and the last are truncated."""
    return synthetic([4, 3, 5, 2], [BASE, LEG, BASE, LEG], truncated=[1, 3])


def test_d4rl_holds_every_step(data: Arrays, tmp_path: Path) -> None:
    export(data, "d4rl", tmp_path / "x.hdf5")
    with h5py.File(tmp_path / "x.hdf5") as file:
        for name in ("observations", "actions", "rewards", "next_observations"):
            assert file[name].dtype == np.float32
            np.testing.assert_array_equal(file[name][()], getattr(data, name), err_msg=name)
        assert np.flatnonzero(file["terminals"]).tolist() == [3, 11]
        assert np.flatnonzero(file["timeouts"]).tolist() == [6, 13]
        assert file["terminals"].dtype == file["timeouts"].dtype == bool
        assert file.attrs["variants"].tolist() == ["hopper-base", "hopper-massdec_25_leggeom"]
        np.testing.assert_array_equal(file["infos/variant_index"][()], data.variant_index)


def test_d4rls_reading_rule_crosses_no_episode(data: Arrays, tmp_path: Path) -> None:
    export(data, "d4rl", tmp_path / "x.hdf5")
    with h5py.File(tmp_path / "x.hdf5") as file:
        kept = np.flatnonzero(~file["timeouts"][:-1])
        within = kept[~file["terminals"][()][kept]]
        following = file["observations"][()][within + 1]
        np.testing.assert_array_equal(following, file["next_observations"][()][within])


@pytest.mark.parametrize(("terminated", "expected"), [(True, (1, 0)), (False, (0, 1))])
def test_d4rl_ends_every_episode_in_one_way(
    tmp_path: Path, terminated: bool, expected: tuple[int, int]
) -> None:
    data = synthetic([3])
    data.terminations[-1], data.truncations[-1] = terminated, terminated
    export(data, "d4rl", tmp_path / "x.hdf5")
    with h5py.File(tmp_path / "x.hdf5") as file:
        assert (file["terminals"][-1], file["timeouts"][-1]) == expected


def test_di_engine_holds_every_transition(data: Arrays, tmp_path: Path) -> None:
    export(data, "di-engine", tmp_path / "x.hdf5")
    with h5py.File(tmp_path / "x.hdf5") as file:
        assert set(file) == {"obs", "action", "reward", "done", "next_obs"}
        assert {len(column) for column in file.values()} == {len(data)}
        np.testing.assert_array_equal(file["next_obs"][()], data.next_observations)
        np.testing.assert_array_equal(file["done"][()], data.terminations)


def test_npz_has_the_originals_columns(data: Arrays, tmp_path: Path) -> None:
    export(data, "npz", tmp_path / "x.npz")
    with np.load(tmp_path / "x.npz") as file:
        assert file.files == ["data"]
        rows = file["data"]
    np.testing.assert_array_equal(rows[:, :3], data.observations)
    np.testing.assert_array_equal(rows[:, 3:5], data.actions)
    np.testing.assert_array_equal(rows[:, 5], data.rewards)
    np.testing.assert_array_equal(rows[:, 6:9], data.next_observations)
    assert np.flatnonzero(rows[:, -1]).tolist() == [3, 6, 11, 13]
    assert rows.shape == (14, 10)


def test_a_record_has_the_header_that_tensorflow_writes() -> None:
    # Length and its masked checksum as TensorFlow 2.21 wrote them for a message of 383 bytes.
    assert record(bytes(383))[:12].hex() == "7f0100000000000056898a13"


@pytest.mark.parametrize(("format", "package"), [("rlds", "google_crc32c"), ("lerobot", "pyarrow")])
def test_a_format_without_its_package_names_the_extra(
    data: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(DependencyError, match=rf'run `pip install "imujoco-minari\[{format}\]"`$'):
        export(data, format, tmp_path / "x")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        # From the same file: an int64 feature, a text, a flag list and a float list.
        ("metadata/seed", np.array([0]), "0a160a0d6d657461646174612f7365656412051a030a0100"),
        (
            "metadata/variant",
            "hopper",
            "0a1e0a106d657461646174612f76617269616e74120a0a080a06686f70706572",
        ),
        (
            "steps/is_last",
            np.array([False] * 4 + [True]),
            "0a1a0a0d73746570732f69735f6c61737412091a070a050000000001",
        ),
        (
            "steps/discount",
            np.ones(5),
            "0a2a0a0e73746570732f646973636f756e74121812160a14" + "0000803f" * 5,
        ),
        # Large and negative numbers are varints.
        ("n", np.array([300]), "1a040a02ac02"),
        ("n", np.array([-25]), "1a0c0a0ae7ffffffffffffffff01"),
    ],
)
def test_an_example_has_the_bytes_that_tensorflow_writes(name: str, value: Any, expected: str) -> None:
    assert example({name: value}).hex().endswith(expected)


def test_rlds_says_what_its_files_hold(data: Arrays, tmp_path: Path) -> None:
    export(data, "rlds", tmp_path / "x")
    info = json.loads((tmp_path / "x" / "dataset_info.json").read_text())
    (split,) = info["splits"]
    (file,) = (tmp_path / "x").glob("*.tfrecord-*")
    assert file.name == "imujoco_hopper-train.tfrecord-00000-of-00001"
    assert (info["name"], split["shardLengths"]) == ("imujoco_hopper", ["4"])
    lengths, content = [], file.read_bytes()
    while content:
        (length,) = struct.unpack("<Q", content[:8])
        lengths.append(length)
        content = content[16 + length :]
    assert (len(lengths), str(sum(lengths))) == (4, split["numBytes"])
    features = json.loads((tmp_path / "x" / "features.json").read_text())["featuresDict"]["features"]
    step = features["steps"]["sequence"]["feature"]["featuresDict"]["features"]
    assert step["action"]["tensor"]["shape"] == {"dimensions": ["2"]}
    assert set(step) == {
        "observation", "action", "reward", "discount", "is_first", "is_last", "is_terminal",
    }  # fmt: skip


def test_rlds_states_the_type_of_the_percents(tmp_path: Path) -> None:
    heavy = Origin("hopper-massinc_37p5_torsogeom", "hopper", "mass", "torsogeom", 37.5, "expert")
    export(synthetic([4, 3], [BASE, heavy]), "rlds", tmp_path / "x")
    features = json.loads((tmp_path / "x" / "features.json").read_text())["featuresDict"]["features"]
    assert features["metadata"]["featuresDict"]["features"]["percent"]["tensor"]["dtype"] == "float32"
    (file,) = (tmp_path / "x").glob("*.tfrecord-*")
    for percent in (0.0, 37.5):
        # The tag and the length of the whole message come first.
        assert example({"metadata/percent": np.array([percent])})[2:] in file.read_bytes()


def test_rlds_starts_a_new_file_when_one_is_full(
    data: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rlds, "_SHARD", 1000)
    export(data, "rlds", tmp_path / "x")
    files = sorted(path.name for path in (tmp_path / "x").glob("*.tfrecord-*"))
    assert len(files) > 1
    assert files[0] == f"imujoco_hopper-train.tfrecord-00000-of-{len(files):05d}"
    (split,) = json.loads((tmp_path / "x" / "dataset_info.json").read_text())["splits"]
    assert sum(map(int, split["shardLengths"])) == 4


def test_lerobot_holds_every_frame(data: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    monkeypatch.setattr(lerobot, "_FILE_FRAMES", 6)
    export(data, "lerobot", tmp_path / "x")
    info = json.loads((tmp_path / "x" / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["fps"]) == ("v3.0", 125)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (4, 14, 2)
    episodes = parquet.read_table(tmp_path / "x" / "meta" / "episodes").to_pylist()
    assert [episode["length"] for episode in episodes] == [4, 3, 5, 2]
    assert [episode["tasks"] for episode in episodes] == [[o.variant] for o in data.origins]
    for number, episode in enumerate(episodes):
        place = {key: episode[f"data/{key}"] for key in ("chunk_index", "file_index")}
        frames = parquet.read_table(tmp_path / "x" / info["data_path"].format(**place))
        chosen = [frame for frame in frames.to_pylist() if frame["episode_index"] == number]
        rows = data.rows(number)
        assert [f["observation.state"] for f in chosen] == data.observations[rows].tolist()
        assert [f["action"] for f in chosen] == data.actions[rows].tolist()
        assert [f["next.done"] for f in chosen] == [False] * (len(chosen) - 1) + [True]
        assert [f["index"] for f in chosen] == list(range(rows.start, rows.stop))
    assert len({(e["data/chunk_index"], e["data/file_index"]) for e in episodes}) > 1


def test_lerobot_has_one_task_for_the_tiers_of_a_variant(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    export(synthetic([2, 2, 2], [BASE, RANDOM, LEG]), "lerobot", tmp_path / "x")
    tasks = parquet.read_table(tmp_path / "x" / "meta" / "tasks.parquet").to_pylist()
    assert tasks == [{"task_index": 0, "task": BASE.variant}, {"task_index": 1, "task": LEG.variant}]
    (frames,) = (tmp_path / "x" / "data").rglob("*.parquet")
    assert parquet.read_table(frames)["task_index"].to_pylist() == [0, 0, 0, 0, 1, 1]
    assert json.loads((tmp_path / "x" / "meta" / "info.json").read_text())["total_tasks"] == 2


@pytest.mark.parametrize("format", ["d4rl", "npz", "rlds"])
def test_states_only_leaves_no_action_and_no_reward(data: Arrays, tmp_path: Path, format: str) -> None:
    export(data, format, tmp_path / "x", states_only=True)
    if format == "d4rl":
        with h5py.File(tmp_path / "x") as file:
            assert not {"actions", "rewards"} & set(file)
            np.testing.assert_array_equal(file["next_observations"][()], data.next_observations)
    elif format == "npz":
        with np.load(tmp_path / "x") as file:
            np.testing.assert_array_equal(file["data"][:, 3:6], data.next_observations)
            assert file["data"].shape == (14, 7)
    else:
        (file,) = (tmp_path / "x").glob("*.tfrecord-*")
        assert b"steps/observation" in file.read_bytes()
        assert b"steps/action" not in file.read_bytes()
        assert b"steps/reward" not in file.read_bytes()
        assert '"action"' not in (tmp_path / "x" / "features.json").read_text()


def test_di_engine_refuses_states_alone(data: Arrays, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="requires actions; valid for states only: d4rl"):
        export(data, "di-engine", tmp_path / "x", states_only=True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("format", ["npz", "rlds"])
def test_what_is_there_is_left_alone_unless_forced(data: Arrays, tmp_path: Path, format: str) -> None:
    target = tmp_path / "x"
    export(data, format, target)
    before = sorted(target.rglob("*")) or target.read_bytes()
    with pytest.raises(DatasetExistsError, match="already exists; it was not changed"):
        export(data.select([0]), format, target)
    assert (sorted(target.rglob("*")) or target.read_bytes()) == before
    assert export(data.select([0]), format, target, force=True).episodes == 1
    assert list(tmp_path.iterdir()) == [target]


def test_a_refusal_removes_what_a_killed_export_left(data: Arrays, tmp_path: Path) -> None:
    target, left = tmp_path / "x", tmp_path / ".imujoco-export-dead"
    export(data, "npz", target)
    left.mkdir()
    (left / "lock").touch()
    with pytest.raises(DatasetExistsError, match="already exists"):
        export(data, "npz", target)
    assert list(tmp_path.iterdir()) == [target]


def test_a_failure_leaves_what_was_there(data: Arrays, tmp_path: Path) -> None:
    target = tmp_path / "x"
    export(data, "npz", target)
    before = target.read_bytes()

    def interrupted() -> None:
        with new_target(target, force=True) as staged:
            staged.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert target.read_bytes() == before
    assert list(tmp_path.iterdir()) == [target]


def test_a_place_that_cannot_be_written_is_said(data: Arrays, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match=r"cannot write .*/file/x"):
        export(data, "npz", tmp_path / "file" / "x")


def test_an_unknown_format_gets_the_nearest(data: Arrays, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"unknown format 'd4lr' \(did you mean 'd4rl'\?\); valid: d4rl"):
        export(data, "d4lr", tmp_path / "x")


def test_the_default_target_is_named_after_the_dataset() -> None:
    assert default_target("imujoco/hopper-base-v0", "d4rl") == Path("hopper-base-v0-d4rl.hdf5")
    assert default_target("imujoco/hopper-base-v0", "rlds", states_only=True) == Path(
        "hopper-base-v0-rlds-states"
    )


@pytest.mark.parametrize("format", sorted(set(FORMATS) - {"lerobot"}))
def test_the_command_exports(
    small_datasets: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    format: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["export", *small_datasets, "--format", format, "--portion", "0", "0.5", "--json"]) == 0
    written = json.loads(capsys.readouterr().out)
    assert written["episodes"] == 8
    assert written["steps"] == len(arrays(small_datasets, portion=(0.0, 0.5)))
    assert Path(written["path"]).exists()
    assert run(["export", *small_datasets, "--format", format]) == 1
    assert "already exists; it was not changed" in capsys.readouterr().err


def test_the_command_names_a_dataset_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["export", "imujoco/hopper-none-v0", "-f", "npz"]) == 2
    assert "imujoco/hopper-none-v0 is not in the Minari root" in capsys.readouterr().err


def test_the_command_writes_preferences(
    small_datasets: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "pairs.npz"
    assert run(["preferences", *small_datasets, "-o", str(target), "-n", "30", "-l", "5"]) == 0
    assert "wrote 30 pairs of 5 steps" in capsys.readouterr().out
    with np.load(target) as saved:
        assert saved["first_observations"].shape == (30, 5, 11)
    assert run(["preferences", *small_datasets, "-o", str(target), "-l", "5"]) == 1
    assert "already exists; it was not changed" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["folder", "file", "hdf5", "zip"])
def test_force_replaces_no_file_or_folder_of_others(data: Arrays, tmp_path: Path, kind: str) -> None:
    target = tmp_path / "x"
    if kind == "folder":
        (target / "thesis").mkdir(parents=True)
    elif kind == "hdf5":
        with h5py.File(target, "w") as file:
            file["obs"] = [1.0]
    elif kind == "zip":
        with target.open("wb") as stream:
            np.savez(stream, data=np.zeros(3))
    else:
        target.write_text("thesis")
    before = sorted(target.rglob("*")) or target.read_bytes()
    with pytest.raises(DatasetExistsError, match=r"x was not replaced: it is not an export of imujoco"):
        export(data, "npz", target, force=True)
    assert (sorted(target.rglob("*")) or target.read_bytes()) == before
    assert list(tmp_path.iterdir()) == [target]


def test_force_replaces_no_export_to_which_a_file_was_added(data: Arrays, tmp_path: Path) -> None:
    export(data, "rlds", tmp_path / "x")
    (tmp_path / "x" / "notes.txt").write_text("thesis")
    with pytest.raises(DatasetExistsError, match="or it has other files too"):
        export(data, "rlds", tmp_path / "x", force=True)
    (tmp_path / "x" / "notes.txt").unlink()
    export(data, "rlds", tmp_path / "x", force=True)


@pytest.mark.parametrize("format", sorted(FORMATS))
@pytest.mark.parametrize("before", ["npz", "rlds"])
def test_force_replaces_an_export_by_one_of_any_format(
    data: Arrays, tmp_path: Path, format: str, before: str
) -> None:
    if format == "lerobot":
        pytest.importorskip("pyarrow")
    export(data, before, tmp_path / "x")
    for _ in range(2):
        export(data, format, tmp_path / "x", force=True)
    assert list(tmp_path.iterdir()) == [tmp_path / "x"]
