"""The archive's layout, read by a program that knows the original's files only, and imported again."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import mujoco
import numpy as np
import pytest
from stable_baselines3 import SAC

from imujoco_minari import publish, verify
from imujoco_minari.cli.app import run
from imujoco_minari.envs import make
from imujoco_minari.envs.mjcf import canonical_mjcf
from imujoco_minari.errors import DatasetError, DatasetExistsError, DatasetNotFoundError, VariantError
from imujoco_minari.exporting import export, export_archive, imujoco
from imujoco_minari.policies.experts import policies_folder, shipped_folder
from imujoco_minari.storage.files import write_json
from imujoco_minari.storage.metadata import complete_metadata
from imujoco_minari.variants import Variant, catalogue
from imujoco_minari.variants.original import file_name

# The length changes the healthy height of this Hopper, and the base's expert falls in it.
FALLING, CHEETAH, WALKER = (
    "hopper-lengthdec_25_footgeom",
    "halfcheetah-jointdec_25_bfoot",
    "walker2d-massinc_50_torsogeom",
)
IDS = [f"imujoco/{variant}-v0" for variant in (FALLING, CHEETAH, WALKER)]
ENVIRONMENTS = {"hopper": "Hopper-v5", "halfcheetah": "HalfCheetah-v5", "walker": "Walker2d-v5"}
KEYS = ("observations", "actions", "rewards", "terminations", "truncations")


SIZES = {"hopper": (11, 3), "halfcheetah": (17, 6), "walker": (17, 6)}


class OriginalProgram:
    """A program for the original's archive: it follows what is known of its files, and nothing of ours.

    Files are found by the robot's word anywhere in their lower-case name. Observation and action are the
    first columns of ``data``; a row with 1 in the last column ends an episode.
    """

    def __init__(self, place: Path, robot: str) -> None:
        self.robot, self.place = robot, place
        names = sorted(path.name for path in (place / "dataset").iterdir())
        self.names = [name for name in names if name.endswith(".npz") and robot in name.lower()]

    def episodes(self, name: str) -> list[tuple[Any, Any]]:
        """Return the states and actions of each episode of a file."""
        with np.load(self.place / "dataset" / name) as file:
            rows = file["data"]
        states, actions = SIZES[self.robot]
        ends = np.flatnonzero(rows[:, -1] == 1.0) + 1
        assert ends[-1] == len(rows)
        parts = np.split(rows, ends[:-1])
        return [(part[:, :states], part[:, states : states + actions]) for part in parts]

    def policy(self, name: str) -> SAC:
        """Return the policy that made a file."""
        return SAC.load(self.place / "policies" / name.replace(".npz", ".zip"), device="cpu")

    def xml(self, name: str) -> Path:
        """Return the model in which a file was made."""
        return self.place / "xml" / name.removeprefix("sac-").replace(".npz", ".xml")


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Minari root with three experts' datasets, two episodes each, and their archive beside it."""
    place = tmp_path_factory.mktemp("published")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(place / "minari"))
        patch.setattr("imujoco_minari.policies.references.EPISODES", 1)
        patch.setenv("IMUJOCO_HOME", str(place / "home"))
        own, base = policies_folder(), shipped_folder() / "hopper-base.json"
        write_json(own / f"{FALLING}.json", json.loads(base.read_text("utf-8")) | {"variant": FALLING})
        shutil.copy(base.with_suffix(".safetensors"), own / f"{FALLING}.safetensors")
        for variant in (FALLING, CHEETAH, WALKER):
            publish(variant, episodes=2)
        export_archive(IDS, place / "imujoco")
    return place


@pytest.fixture
def place(published: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The archive; the Minari root and the policies are those of its datasets."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(published / "minari"))
    monkeypatch.setenv("IMUJOCO_HOME", str(published / "home"))
    return published / "imujoco"


def recorded(dataset_id: str) -> list[Any]:
    return list(minari.load_dataset(dataset_id).iterate_episodes())


@pytest.mark.parametrize("robot", ["hopper", "halfcheetah", "walker"])
def test_a_program_for_the_original_reads_the_episodes(place: Path, robot: str) -> None:
    program = OriginalProgram(place, robot)
    (name,) = program.names
    episodes = recorded(f"imujoco/{program.xml(name).stem}-v0")
    read = program.episodes(name)
    assert len(read) == len(episodes) == 2
    for (states, actions), episode in zip(read, episodes, strict=True):
        np.testing.assert_array_equal(states, episode.observations[:-1])
        np.testing.assert_array_equal(actions.astype(np.float32), episode.actions)


@pytest.mark.parametrize("robot", ["hopper", "halfcheetah", "walker"])
def test_the_policies_load_and_act_as_the_data(place: Path, robot: str) -> None:
    program = OriginalProgram(place, robot)
    (name,) = program.names
    model = program.policy(name)
    # The spaces are those of Gymnasium's own environment, so training can go on there.
    model.set_env(gym.make(ENVIRONMENTS[robot]))
    states, actions = program.episodes(name)[0]
    np.testing.assert_allclose(model.predict(states, deterministic=True)[0], actions, atol=2e-5)


@pytest.mark.parametrize("robot", ["halfcheetah", "walker"])
def test_gymnasium_with_the_xml_makes_the_data_again(place: Path, robot: str) -> None:
    """Gymnasium's own environment, with ``xml_file`` as the original's authors gave it, step by step."""
    program = OriginalProgram(place, robot)
    (name,) = program.names
    env = gym.make(ENVIRONMENTS[robot], xml_file=str(program.xml(name)))
    dataset = minari.load_dataset(f"imujoco/{program.xml(name).stem}-v0")
    episode = next(iter(dataset.iterate_episodes([1])))
    seed = next(iter(dataset.storage.get_episode_metadata([1])))["seed"]
    observations, rewards = [env.reset(seed=int(seed))[0]], []
    for action in episode.actions:
        observation, reward, *_ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
    env.close()
    np.testing.assert_array_equal(np.array(observations), episode.observations)
    np.testing.assert_array_equal(np.array(rewards), episode.rewards)


def fields(model: mujoco.MjModel) -> dict[str, Any]:
    """Every field of a compiled model, and of its options, statistics and visual settings."""
    found: dict[str, Any] = {}
    parts = {"": model, "opt.": model.opt, "stat.": model.stat} | {
        f"vis.{name}.": getattr(model.vis, name) for name in dir(model.vis) if not name.startswith("_")
    }
    for prefix, part in parts.items():
        for name in dir(part):
            value = None if name.startswith("_") else getattr(part, name)
            if isinstance(value, int | float | bytes | np.ndarray):
                found[prefix + name] = value
    return found


@pytest.mark.parametrize("robot", ["hopper", "halfcheetah", "walker2d"])
def test_mujoco_loads_every_model_as_the_variants_in_every_field(tmp_path: Path, robot: str) -> None:
    """All variants of the robot: the file on disk, against the model that the environment steps."""
    for variant in catalogue(robot):
        path = tmp_path / f"{variant}.xml"
        imujoco.write_model(variant, path)
        # MuJoCo 2 knows no such attribute of a light.
        assert 'type="directional"' not in path.read_text("utf-8")
        env = make(variant)
        mine, theirs = fields(mujoco.MjModel.from_xml_path(str(path))), fields(env.unwrapped.model)  # type: ignore[attr-defined]
        env.close()
        assert len(mine) > 300
        # Gymnasium's environment raises the size of the picture to its own.
        for key in ("vis.global_.offwidth", "vis.global_.offheight"):
            del mine[key], theirs[key]
        assert mine.keys() == theirs.keys()
        differing = [key for key in mine if not np.array_equal(mine[key], theirs[key])]
        assert differing == [], str(variant)


def test_the_comparison_of_models_sees_a_difference() -> None:
    leg, base = (
        fields(mujoco.MjModel.from_xml_string(canonical_mjcf(Variant.parse(name))))
        for name in ("hopper-massdec_25_leggeom", "hopper-base")
    )
    differing = {key for key in leg if not np.array_equal(leg[key], base[key])}
    assert {"body_mass", "body_inertia"} <= differing


def test_an_import_gives_the_same_datasets_again(
    place: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("imujoco_minari.importing.originals.REFERENCE_EPISODES", 1)
    before = {dataset_id: recorded(dataset_id) for dataset_id in IDS}
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "again"))
    assert run(["import-archive", str(place), "--json"]) == 0
    for dataset_id, episodes in before.items():
        again = recorded(dataset_id.replace("imujoco/", "imujoco-original/"))
        for mine, theirs in zip(again, episodes, strict=True):
            for key in KEYS:
                first, second = getattr(mine, key), getattr(theirs, key)
                np.testing.assert_array_equal(first, second)
                assert first.dtype == second.dtype
    assert any(episode.terminations[-1] for episode in before[IDS[0]])
    assert not any(episode.terminations.any() for episode in before[IDS[1]])
    again = IDS[1].replace("imujoco/", "imujoco-original/")
    assert verify(again) == []
    # The original's authors made none of this.
    metadata = minari.load_dataset(again).storage.metadata
    assert metadata["author"] == {"imujoco_minari"}
    assert f"data of {CHEETAH}, rebuilt" in metadata["description"]
    assert "gym's v3" not in metadata["description"]


def test_the_column_before_the_last_tells_a_fall_from_the_time_limit(place: Path) -> None:
    with np.load(place / file_name("dataset", Variant.parse(FALLING))) as file:
        rows = file["data"]
    episodes = recorded(IDS[0])
    assert rows[:, -2].tolist() == [flag for episode in episodes for flag in episode.terminations]


def test_what_is_missing_is_named_before_anything_is_written(
    place: Path, tmp_path: Path, capsys: Any
) -> None:
    target = tmp_path / "out"
    with pytest.raises(DatasetNotFoundError, match="make it with `imujoco publish hopper-base`"):
        export_archive([*IDS, "imujoco/hopper-base-v0"], target)
    assert run(["export", "--format", "imujoco", "--robot", "halfcheetah", "-o", str(target)]) == 2
    assert (
        "52 of 53 datasets are not in the Minari root: "
        "make them with `imujoco publish --robot halfcheetah`" in capsys.readouterr().err
    )
    assert run(["export", "--format", "imujoco", "imujoco/x-v0", "--dry-run", "-o", str(target)]) == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"policy_sha256": "0" * 64}, "was made with another policy than the installed one"),
        ({"mjcf_sha256": "0" * 64}, "was made with another model than the installed one"),
    ],
)
def test_data_of_another_policy_or_model_is_refused(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, str], message: str
) -> None:
    """Else the archive would hold a policy beside data that it did not make."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    publish(FALLING, episodes=1)
    complete_metadata(tmp_path / "minari" / IDS[0] / "data", change)
    with pytest.raises(DatasetError, match=message):
        export_archive(IDS[:1], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_the_archive_cannot_hold_is_refused(place: Path, tmp_path: Path, capsys: Any) -> None:
    target = tmp_path / "out"
    publish("hopper-base", tier="random", episodes=1)
    with pytest.raises(DatasetError, match="the policy of each dataset, and random has no network"):
        export_archive("imujoco/hopper-base-random-v0", target)
    with pytest.raises(DatasetError, match="are of one variant; the archive has one dataset of each"):
        export_archive([IDS[0], IDS[0].replace("-v0", "-medium-v0")], target)
    with pytest.raises(VariantError, match="is not the dataset id of a variant"):
        export_archive(["imujoco-original/hopper-base-v0"], target)
    with pytest.raises(DatasetError, match=r"is a folder of many datasets: see export_archive\(\)"):
        export(IDS[0], "imujoco", target)
    for options in (["--states-only"], ["--portion", "0", "0.5"]):
        assert run(["export", "--format", "imujoco", IDS[0], "-o", str(target), *options]) == 1
        assert "leave out --states-only and --portion" in capsys.readouterr().err
    assert run(["export", "--format", "imujoco", IDS[0]]) == 2
    assert "name the new file or folder with --output" in capsys.readouterr().err


def test_the_command_says_what_it_will_take_and_writes_whole(
    place: Path, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "out"
    command = ["export", "--format", "imujoco", *IDS, "--output", str(target)]
    assert run([*command, "--dry-run"]) == 0
    assert "3 datasets, 6 episodes, " in (said := capsys.readouterr().err)
    assert "MB and " in said
    assert not target.exists()
    assert run([*command, "--dry-run", "--json"]) == 0
    planned = json.loads(capsys.readouterr().out)
    written = sum(path.stat().st_size for path in place.rglob("*") if path.is_file())
    assert planned["bytes"] == pytest.approx(written, rel=0.02)

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(imujoco, "write_model", fail)
        assert run(command) == 1
    assert "No space left on device" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []

    assert run([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 6
    with pytest.raises(DatasetExistsError):
        export_archive(IDS, target)
    assert export_archive(IDS[:1], target, force=True).episodes == 2
    assert [path.name for path in (target / "dataset").iterdir()] == [f"sac-{FALLING}.npz"]
