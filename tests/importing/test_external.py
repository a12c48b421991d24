"""Others' data as a variant's tier: Minari, D4RL's HDF5, npz; and what is refused."""

from __future__ import annotations

import gc
import json
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import numpy as np
import original_archive
import pytest
from minari import DataCollector

from imujoco_minari import publish, verify
from imujoco_minari.cli.app import run
from imujoco_minari.errors import DatasetError, DatasetNotFoundError, ImujocoError
from imujoco_minari.importing import safe_unpack
from imujoco_minari.importing.external import import_dataset, read_source
from imujoco_minari.storage import file_format
from imujoco_minari.variants import Variant
from imujoco_minari.verification import child_process

BASE = Variant.parse("hopper-base")
KEYS = ("observations", "actions", "rewards", "terminations", "truncations")

pytestmark = pytest.mark.usefixtures("checked_here")


def episodes(dataset_id: str) -> list[Any]:
    return list(minari.load_dataset(dataset_id).iterate_episodes())


def assert_same_episodes(first: str, second: str) -> None:
    pairs = list(zip(episodes(first), episodes(second), strict=True))
    assert pairs
    for mine, theirs in pairs:
        for key in KEYS:
            np.testing.assert_array_equal(getattr(mine, key), getattr(theirs, key))


def flat(rows: Any) -> dict[str, Any]:
    """D4RL's arrays of a table of observation, action, reward, next observation and done."""
    return {
        "observations": rows[:, :11].astype(np.float32),
        "actions": rows[:, 11:14].astype(np.float32),
        "rewards": rows[:, 14].astype(np.float32),
        "next_observations": rows[:, 15:26].astype(np.float32),
        "terminals": rows[:, -1].astype(bool),
        "timeouts": np.zeros(len(rows), bool),
    }


def table(episodes: int = 3) -> Any:
    return original_archive.table(
        "hopper-massinc_0_leggeom", episodes, ("reward", "next_observation", "done")
    )


def write_hdf5(path: Path, arrays: dict[str, Any]) -> Path:
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name] = array
    return path


def collect_with_stock_minari(dataset_id: str) -> None:
    collector = DataCollector(gym.make("Hopper-v5"))
    for seed in range(2):
        collector.reset(seed=seed)
        collector.action_space.seed(seed)
        ended = False
        while not ended:
            _, _, terminated, truncated, _ = collector.step(collector.action_space.sample())
            ended = terminated or truncated
    collector.create_dataset(
        dataset_id,
        algorithm_name="Noise",
        author={"Somebody"},
        author_email={"nobody@example.org"},
        code_permalink="https://example.org",
        description="x",
    )
    collector.close()


def test_a_stock_minari_dataset_becomes_a_tier(root: Path) -> None:
    with warnings.catch_warnings():
        # Stock Minari warns of what is optional, and leaves temporary folders to the garbage collector.
        warnings.simplefilter("ignore")
        collect_with_stock_minari("mujoco/hopper/some-v0")
        gc.collect()
    imported = import_dataset("mujoco/hopper/some-v0", BASE, "farama")
    assert imported.published.dataset_id == "imujoco/hopper-base-farama-v0"
    assert_same_episodes("imujoco/hopper-base-farama-v0", "mujoco/hopper/some-v0")
    assert verify("imujoco/hopper-base-farama-v0") == []
    found = minari.load_dataset("imujoco/hopper-base-farama-v0").storage.metadata
    assert (found["algorithm_name"], found["author"]) == ("Noise", {"Somebody"})
    assert found["replayable"] is False
    assert imported.one_step.position_max is not None
    assert imported.one_step.position_max < 1e-9
    assert imported.notes == ()
    again = import_dataset(str(root / "mujoco/hopper/some-v0"), BASE, "farama")
    assert not again.published.created


def test_d4rl_hdf5_becomes_a_tier(tmp_path: Path) -> None:
    arrays = flat(table())
    imported = import_dataset(str(write_hdf5(tmp_path / "hopper.hdf5", arrays)), BASE, "d4rl-medium")
    dataset_id = imported.published.dataset_id
    assert dataset_id == "imujoco/hopper-base-d4rl-medium-v0"
    assert verify(dataset_id) == []
    found = episodes(dataset_id)
    np.testing.assert_array_equal(
        np.vstack([e.observations[1:] for e in found]), arrays["next_observations"].astype(np.float64)
    )
    np.testing.assert_array_equal(np.vstack([e.actions for e in found]), arrays["actions"])
    assert all(e.terminations[-1] and not e.truncations[-1] for e in found)


def test_timeouts_are_truncations_and_missing_next_observations_are_simulated(tmp_path: Path) -> None:
    arrays = flat(table())
    arrays["terminals"], arrays["timeouts"] = arrays["timeouts"], arrays["terminals"]
    expected = arrays.pop("next_observations")[arrays["timeouts"]]
    imported = import_dataset(str(write_hdf5(tmp_path / "hopper.hdf5", arrays)), BASE, "d4rl")
    found = episodes(imported.published.dataset_id)
    assert all(e.truncations[-1] and not e.terminations[-1] for e in found)
    np.testing.assert_allclose(np.array([e.observations[-1] for e in found]), expected, atol=1e-3)
    assert "simulated from the one before it" in imported.notes[0]


@pytest.mark.parametrize("named", [False, True])
def test_npz_becomes_a_tier(tmp_path: Path, named: bool) -> None:
    rows = table()
    if named:
        np.savez(
            tmp_path / "hopper.npz",
            obs=rows[:, :11],
            acts=rows[:, 11:14],
            rews=rows[:, 14],
            next_obs=rows[:, 15:26],
            dones=rows[:, -1],
        )
    else:
        np.savez(tmp_path / "hopper.npz", data=rows)
    imported = import_dataset(str(tmp_path / "hopper.npz"), BASE, "theirs")
    assert verify(imported.published.dataset_id) == []
    found = episodes(imported.published.dataset_id)
    np.testing.assert_array_equal(np.vstack([e.observations[1:] for e in found]), rows[:, 15:26])
    np.testing.assert_array_equal(np.concatenate([e.rewards for e in found]), rows[:, 14])


@pytest.mark.parametrize("format_", ["npz", "d4rl"])
def test_what_this_package_exports_it_imports(
    tmp_path: Path, format_: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What is measured is kept by variant: one that no other test takes.
    monkeypatch.setattr("imujoco_minari.policies.references.EPISODES", 1)
    variant = Variant.parse("halfcheetah-massinc_7_bfoot")
    publish(variant, tier="random", episodes=2)
    target = str(tmp_path / ("out.hdf5" if format_ == "d4rl" else "out.npz"))
    source = variant.dataset_id("random")
    assert run(["export", source, "--format", format_, "--output", target]) == 0
    again = import_dataset(target, variant, "again").published.dataset_id
    if format_ == "npz":
        assert_same_episodes(again, source)
        return
    for mine, theirs in zip(episodes(again), episodes(source), strict=True):
        np.testing.assert_array_equal(mine.observations, theirs.observations.astype(np.float32))
        np.testing.assert_array_equal(mine.rewards, theirs.rewards.astype(np.float32))
        np.testing.assert_array_equal(mine.truncations, theirs.truncations)


def test_import_says_how_far_the_steps_are_from_the_variant(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez(tmp_path / "hopper.npz", data=table())
    source = str(tmp_path / "hopper.npz")
    wrong = "hopper-massinc_200_torsogeom"
    for variant in ("hopper-base", wrong):
        assert run(["import", source, "--variant", variant, "--tier", "theirs", "--json"]) == 0
    shown = [json.loads(text + "}") for text in capsys.readouterr().out.split("\n}\n")[:-1]]
    near, far = (each["one_step_difference"]["position_median"] for each in shown)
    assert near < 1e-12 < 1e-5 < far
    assert run(["import", source, "--variant", wrong, "--tier", "again"]) == 0
    assert f"of its steps, simulated again in {wrong}, end elsewhere by" in capsys.readouterr().out


def test_what_cannot_be_imported_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arrays = flat(table())
    for kept, message in (
        (("actions", "terminals"), "has no observations and actions, but actions, terminals"),
        (("observations", "actions"), "nothing says where episodes end"),
    ):
        path = write_hdf5(tmp_path / "part.hdf5", {key: arrays[key] for key in kept})
        with pytest.raises(DatasetError, match=message):
            read_source(str(path), "hopper")
    np.savez(tmp_path / "number.npz", observations=0.0, actions=0.0, dones=0.0)
    with pytest.raises(DatasetError, match=r"observations are of shape \(\); hopper needs \(1, 11\)"):
        read_source(str(tmp_path / "number.npz"), "hopper")
    named = {"terminals": "terminations", "timeouts": "truncations", "dones": "ends"}
    for flag, what in named.items():
        steps = {name: arrays[name] for name in ("observations", "actions")}
        np.savez(tmp_path / "half.npz", **steps, **{flag: np.full(len(arrays["rewards"]), 0.5)})
        with pytest.raises(DatasetError, match=f"{what} hold other numbers than 0 and 1"):
            read_source(str(tmp_path / "half.npz"), "hopper")
        np.savez(tmp_path / "short.npz", **steps, **{flag: np.zeros(2)})
        with pytest.raises(DatasetError, match=rf"{what} are of shape \(2,\)"):
            read_source(str(tmp_path / "short.npz"), "hopper")
    with pytest.raises(DatasetError, match=r"observations are of shape \(.*, 11\); walker2d needs"):
        read_source(str(write_hdf5(tmp_path / "h.hdf5", arrays)), "walker2d")
    (tmp_path / "x.txt").write_text("x")
    with pytest.raises(DatasetError, match=r"neither \.npz nor HDF5"):
        read_source(str(tmp_path / "x.txt"), "hopper")
    with pytest.raises(DatasetError, match=r"holds no Minari dataset .*import-archive"):
        read_source(str(tmp_path), "hopper")
    with pytest.raises(DatasetNotFoundError, match="no such file, folder or dataset"):
        read_source("nothing", "hopper")
    with pytest.raises(
        DatasetError, match="is a D4RL HDF5 file whose arrays have names: leave out --columns"
    ):
        import_dataset(str(tmp_path / "h.hdf5"), BASE, "t", columns="observation,action,done")
    assert run(["import", "mujoco/hopper/x-v0", "--variant", "hopper-base", "--tier", "t"]) == 2
    assert "minari download mujoco/hopper/x-v0" in capsys.readouterr().err
    assert run(["import", "x", "--variant", "hopper-bas", "--tier", "t"]) == 2
    assert run(["import", str(tmp_path / "h.hdf5"), "--variant", "hopper-base", "--tier", "No Tier"]) == 2


def test_a_minari_file_by_itself_is_pointed_to_its_folder(root: Path) -> None:
    publish("hopper-base", tier="random", episodes=1)
    path = file_format.main_file(root / "imujoco" / "hopper-base-random-v0" / "data")
    with pytest.raises(DatasetError, match="give the dataset's folder, or its id"):
        read_source(str(path), "hopper")


def test_what_lies_in_other_files_is_not_read(tmp_path: Path, root: Path) -> None:
    arrays = flat(table())
    write_hdf5(tmp_path / "secret.hdf5", arrays)
    observations = arrays.pop("observations")
    path = write_hdf5(tmp_path / "link.hdf5", arrays)
    with h5py.File(path, "a") as file:
        file["observations"] = h5py.ExternalLink("secret.hdf5", "observations")
    with pytest.raises(DatasetError, match="observations is not an array of this file"):
        read_source(str(path), "hopper")
    path = write_hdf5(tmp_path / "virtual.hdf5", arrays)
    with h5py.File(path, "a") as file:
        layout = h5py.VirtualLayout(observations.shape, observations.dtype)
        layout[:] = h5py.VirtualSource(tmp_path / "secret.hdf5", "observations", observations.shape)
        file.create_virtual_dataset("observations", layout)
    with pytest.raises(DatasetError, match="takes its values from another file"):
        read_source(str(path), "hopper")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"shape": (10**12, 11), "chunks": (1, 11)},
            "claims 11000000000000 numbers; the arrays",
        ),
        ({"shape": (10**7, 11), "chunks": (10**4, 11)}, "more than the file stores"),
        ({"shape": (10**7, 11), "chunks": (10**4, 11), "compression": "gzip"}, "more than the file stores"),
        ({"shape": (10**7, 11)}, "more than the file stores"),
        ({"shape": (3, 11), "chunks": (10**8, 11), "maxshape": (None, 11)}, "claims 1100000000 numbers"),
    ],
)
def test_arrays_that_claim_too_much_are_refused_unread(
    tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    path = write_hdf5(tmp_path / "large.hdf5", {"actions": np.zeros((3, 3)), "terminals": np.zeros(3)})
    with h5py.File(path, "a") as file:
        # Not one of its values is written.
        file.create_dataset("observations", dtype="f4", **options)
    assert path.stat().st_size < 10_000
    with pytest.raises(DatasetError, match=message):
        read_source(str(path), "hopper")


def test_the_arrays_of_a_file_are_bounded_together(
    tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrays = flat(table())
    numbers = sum(array.size for array in arrays.values())
    path = write_hdf5(tmp_path / "d4rl.hdf5", arrays)
    # Two episodes that share the storage of one.
    publish("hopper-base", tier="random", episodes=1)
    folder = root / "imujoco" / "hopper-base-random-v0"
    with h5py.File(file_format.main_file(folder / "data"), "a") as file:
        file["episode_1"] = file["episode_0"]
        values = sum(file["episode_0"][name].size for name in KEYS)
    monkeypatch.setattr(safe_unpack, "MAX_NUMBERS", numbers)
    read_source(str(path), "hopper")
    monkeypatch.setattr(safe_unpack, "MAX_NUMBERS", numbers - 1)
    with pytest.raises(DatasetError, match="the arrays of one import may have"):
        read_source(str(path), "hopper")
    monkeypatch.setattr(safe_unpack, "MAX_NUMBERS", 2 * values - 1)
    with pytest.raises(DatasetError, match=r"episode_1: .* the arrays of one import may have"):
        read_source(str(folder), "hopper")


def test_compressed_arrays_are_read(tmp_path: Path) -> None:
    arrays = flat(table())
    with h5py.File(tmp_path / "d4rl.hdf5", "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array, compression="gzip")
    read = read_source(str(tmp_path / "d4rl.hdf5"), "hopper").transitions
    np.testing.assert_array_equal(read.observations, arrays["observations"].astype(np.float64))


def test_a_foreign_environment_is_never_made(tmp_path: Path, root: Path) -> None:
    publish("hopper-base", tier="random", episodes=1)
    folder = root / "imujoco" / "hopper-base-random-v0"
    path = folder / "data" / "metadata.json"
    found = json.loads(path.read_text())
    mark = tmp_path / "ran"
    spec = json.loads(found["env_spec"])
    spec["entry_point"], spec["kwargs"] = "pathlib:Path.touch", {"self": str(mark)}
    found["env_spec"] = json.dumps(spec)
    del found["observation_space"], found["action_space"]
    path.write_text(json.dumps(found))
    import_dataset(str(folder), BASE, "theirs")
    assert not mark.exists()


@pytest.mark.parametrize("cut", [100, 2000])
def test_a_truncated_file_fails_in_one_line(tmp_path: Path, cut: int) -> None:
    path = write_hdf5(tmp_path / "h.hdf5", flat(table()))
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(ImujocoError) as raised:
        read_source(str(path), "hopper")
    assert "\n" not in str(raised.value)


def test_a_file_that_hangs_hdf5_is_met_by_another_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_hdf5(tmp_path / "d4rl.hdf5", flat(table(1)))
    assert child_process.survives_walk(path) is None
    monkeypatch.setattr(child_process, "_WALK", "limited_calls:compute")
    monkeypatch.setattr(child_process, "_SECONDS", 1)
    with pytest.raises(DatasetError, match=r"d4rl.hdf5: cannot be read: .* more than 1 seconds"):
        read_source(str(path), "hopper")
