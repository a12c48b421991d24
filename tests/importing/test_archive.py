"""The original's archive, published: as it is, recollected, combined; and the commands for it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import minari
import numpy as np
import original_archive
import pytest

from imujoco_minari import combine_datasets, verify
from imujoco_minari.cli.app import run
from imujoco_minari.envs import environment_spec
from imujoco_minari.envs.mjcf import canonical_mjcf, mjcf_sha256
from imujoco_minari.errors import DatasetError, DatasetExistsError
from imujoco_minari.importing import originals
from imujoco_minari.importing.archive import open_archive
from imujoco_minari.importing.catalogue_diff import published_models
from imujoco_minari.importing.originals import Import, import_archive, import_variant, recollect
from imujoco_minari.pictures.rendering.motion import replay
from imujoco_minari.publishing.outcome import Published
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.storage.metadata import complete_metadata
from imujoco_minari.variants import Variant
from imujoco_minari.variants.original import OriginalVariant

HOPPER = "hopper-massdec_25_leggeom"
ODD = "walker2d-frictiondec_50_footleftgeom"

pytestmark = pytest.mark.usefixtures("in_process", "checked_here")


@pytest.fixture(autouse=True)
def few_random_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imujoco_minari.importing.originals.REFERENCE_EPISODES", 2)


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return original_archive.write_archive(tmp_path / "archive", (HOPPER, ODD))


def metadata(dataset_id: str) -> dict[str, object]:
    found: dict[str, object] = minari.load_dataset(dataset_id).storage.metadata
    return found


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize("nested", [False, True])
def test_variants_are_found_unpacked_or_zipped(tmp_path: Path, zipped: bool, nested: bool) -> None:
    place = tmp_path / "archive"
    inner = original_archive.write_archive(place / "imujoco" if nested else place, (HOPPER, ODD), 1)
    (inner / "xml" / "readme.txt").write_text("hello")
    (inner / "dataset" / "sac-ant-massdec_25_leg.npz").write_bytes(b"")
    if zipped:
        original_archive.zip_parts(inner)
    archive = open_archive(place)
    assert [str(variant) for variant in archive.variants] == [HOPPER, ODD]
    assert archive.ignored == ("dataset/sac-ant-massdec_25_leg.npz", "xml/readme.txt")
    outcomes = list(import_archive(archive, archive.variants, Import()))
    assert [outcome.error for outcome in outcomes] == ["", ""]
    assert all(outcome.created for outcome in outcomes)
    assert not list(tmp_path.glob("imujoco-*"))


def test_an_imported_dataset_is_the_archives_bit_for_bit(place: Path) -> None:
    variant = OriginalVariant.parse(HOPPER)
    published = import_variant(open_archive(place), variant, Import())
    assert published.dataset_id == f"imujoco-original/{HOPPER}-v0"
    assert verify(published.dataset_id) == []
    with np.load(place / "dataset" / f"sac-{HOPPER}.npz") as arrays:
        table = arrays["data"]
    dataset = minari.load_dataset(published.dataset_id)
    episodes = list(dataset.iterate_episodes())
    assert len(episodes) == 3
    np.testing.assert_array_equal(np.vstack([e.observations[:-1] for e in episodes]), table[:, :11])
    np.testing.assert_array_equal(np.vstack([e.actions for e in episodes]), table[:, 11:14])
    np.testing.assert_array_equal(np.concatenate([e.rewards for e in episodes]), table[:, 14])
    assert dataset.total_steps == len(table)
    found = metadata(published.dataset_id)
    assert {key: found[key] for key in ("variant", "robot", "category", "body", "percent", "tier")} == {
        "variant": HOPPER,
        "robot": "hopper",
        "category": "mass",
        "body": "leggeom",
        "percent": -25,
        "tier": "expert",
    }
    assert found["replayable"] is False
    assert found["catalogue"] == "imujoco-original"
    assert found["source_columns"] == "observation,action,reward,done"
    assert "cannot be replayed" in str(found["description"])
    assert "final observation of each episode is simulated" in str(found["description"])
    assert found["mjcf_source"] == original_archive.gym_xml(HOPPER)
    assert published.return_mean == found["ref_max_score"]


def test_the_environment_of_an_original_is_recovered_without_the_archive(place: Path) -> None:
    variant = OriginalVariant.parse(ODD)
    import_variant(open_archive(place), variant, Import())
    for path in sorted(place.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    dataset = minari.load_dataset(f"imujoco-original/{ODD}-v0")
    env = dataset.recover_environment()
    model = env.unwrapped.model  # type: ignore[attr-defined]
    assert model.geom("foot_left_geom").friction[0] == 1.9 * 0.5
    assert model.geom("foot_geom").friction[0] == 0.9
    env.reset(seed=0)
    env.close()


def test_recollected_data_replay_bit_for_bit(place: Path) -> None:
    how = Import(episodes=2, seed=3)
    published = recollect(open_archive(place), OriginalVariant.parse(HOPPER), how)
    assert published.dataset_id == f"imujoco-original/{HOPPER}-recollected-v0"
    assert verify(published.dataset_id) == []
    found = metadata(published.dataset_id)
    assert found["tier"] == "recollected"
    assert "replayable" not in found
    assert found["policy_deterministic"] is True
    assert found["algorithm_name"] == "SAC"
    variant = OriginalVariant.parse(HOPPER)
    assert not recollect(open_archive(place), variant, how).created
    with pytest.raises(DatasetExistsError, match="it has 2 episodes; you asked for 3 episodes"):
        recollect(open_archive(place), variant, replace(how, episodes=3))
    with h5py.File(file_format.main_file(str(published.path) + "/data"), "a") as file:
        assert file["episode_0"].attrs["seed"] != file["episode_1"].attrs["seed"]
        file["episode_0/rewards"][0] += 1e-9
    assert any("rewards[0]" in finding.where for finding in verify(published.dataset_id))


def as_before(dataset_id: str) -> None:
    """Store the environment of a dataset as versions before VariantEnv took a text did."""
    path = minari_root.dataset_folder(dataset_id) / "data" / "metadata.json"
    found = json.loads(path.read_text())
    today = "imujoco_minari.envs:"
    assert today in found["env_spec"]
    spec = found["env_spec"].replace(today, "imujoco_minari.importing.environments:Original")
    found["env_spec"] = spec.replace("VariantEnv", "Env")
    path.write_text(json.dumps(found))
    complete_metadata(path.parent, {})


def test_datasets_of_earlier_versions_load_verify_combine_and_replay(tmp_path: Path) -> None:
    names = (HOPPER, "hopper-massinc_200_torsogeom")
    archive = open_archive(original_archive.write_archive(tmp_path / "archive", names, 2))
    how = Import(episodes=2)
    ids = [recollect(archive, variant, how).dataset_id for variant in archive.variants]
    as_before(ids[0])
    assert verify(ids[0]) == []
    assert "OriginalHopperEnv" in str(metadata(ids[0])["env_spec"])
    env = minari.load_dataset(ids[0]).recover_environment()
    assert env.unwrapped.mjcf == archive.mjcf(archive.variants[0])[1]  # type: ignore[attr-defined]
    env.close()
    motion = replay(ids[0], 1)
    assert motion.divergence == 0.0
    assert motion.variant == archive.variants[0]
    collection = combine_datasets(ids, "imujoco-original/hopper-two-v0")
    as_before(collection.id)
    assert verify(collection.id) == []
    assert replay(collection.id, 3).divergence == 0.0
    env = minari.load_dataset(collection.id).recover_environment()
    assert env.unwrapped.variants == names  # type: ignore[attr-defined]
    env.close()


def test_a_variant_of_ours_takes_no_text_of_a_model(root: Path) -> None:
    assert run(["publish", "hopper-base", "--tier", "random", "--episodes", "1", "--json"]) == 0
    path = minari_root.dataset_folder("imujoco/hopper-base-random-v0") / "data" / "metadata.json"
    found = json.loads(path.read_text())
    found["env_spec"] = environment_spec(
        "hopper-base", canonical_mjcf(Variant.parse("hopper-base"))
    ).to_json()
    path.write_text(json.dumps(found))
    complete_metadata(path.parent, {})
    (finding, *_) = verify("imujoco/hopper-base-random-v0")
    assert finding.where == "metadata.json/env_spec"
    assert "follows from its id" in finding.what


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ('<option iterations="+2000000000" tolerance="0"/>', "opt.iterations of the compiled model"),
        ('<asset><mesh name="m" file="/etc/passwd"/></asset>', "<mesh> is refused"),
    ],
)
def test_verify_ends_whatever_the_stored_model_is(place: Path, change: str, message: str) -> None:
    """The dataset is consistent: its model is hostile, and all digests are right."""
    how = Import(episodes=1)
    dataset_id = recollect(open_archive(place), OriginalVariant.parse(HOPPER), how).dataset_id
    data = minari_root.dataset_folder(dataset_id) / "data"
    found = json.loads((data / "metadata.json").read_text())
    with h5py.File(file_format.main_file(data), "a") as file:
        text = str(file.attrs["mjcf"]).replace("<worldbody>", f"{change}<worldbody>")
        file.attrs["mjcf"], file.attrs["mjcf_sha256"] = text, mjcf_sha256(text)
    found |= {"mjcf_sha256": mjcf_sha256(text), "env_spec": environment_spec(HOPPER, text).to_json()}
    (data / "metadata.json").write_text(json.dumps(found))
    complete_metadata(data, {})
    (finding,) = verify(dataset_id)
    assert message in finding.what


def test_verify_sees_that_an_original_runs_another_model(place: Path) -> None:
    published = import_variant(open_archive(place), OriginalVariant.parse(HOPPER), Import())
    path = Path(str(published.path)) / "data" / "metadata.json"
    found = json.loads(path.read_text())
    found["env_spec"] = found["env_spec"].replace("leg_joint", "leg_joint ")
    path.write_text(json.dumps(found))
    assert any("env_spec" in finding.where for finding in verify(published.dataset_id))


def test_a_variant_that_fails_does_not_stop_the_others(place: Path, root: Path) -> None:
    (place / "dataset" / f"sac-{HOPPER}.npz").unlink()
    archive = open_archive(place)
    first, second = import_archive(archive, archive.variants, Import())
    assert "has no dataset/sac-hopper-massdec_25_leggeom.npz" in first.error
    assert second.created
    assert list(minari.list_local_datasets()) == [f"imujoco-original/{ODD}-v0"]


@pytest.mark.parametrize(("act", "reader"), [(import_variant, "read_npz"), (recollect, "read_actor")])
def test_what_is_there_is_left_alone_unless_forced(
    place: Path, act: Callable[..., Published], reader: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive, variant = open_archive(place), OriginalVariant.parse(HOPPER)
    how = Import(episodes=1)
    first = act(archive, variant, how)
    with monkeypatch.context() as patch:
        # What is there is found by the file's digest, and nothing else is done.
        patch.setattr(originals, reader, None)
        again = act(archive, variant, how)
    assert (first.created, again.created) == (True, False)
    assert act(archive, variant, replace(how, force=True)).created


def test_a_file_without_the_array_data_is_named(place: Path) -> None:
    np.savez(place / "dataset" / f"sac-{HOPPER}.npz", other=np.zeros((3, 16)))
    with pytest.raises(DatasetError, match="holds no array 'data', but other"):
        import_variant(open_archive(place), OriginalVariant.parse(HOPPER), Import())


def test_a_policy_of_another_robot_is_refused(place: Path) -> None:
    original_archive.write_sb3_zip(place / "policies" / f"sac-{HOPPER}.zip", "halfcheetah")
    archive = open_archive(place)
    outcomes = list(import_archive(archive, archive.variants, Import(recollect=True, episodes=1)))
    assert "the policy maps 17 observations to 6 actions, but hopper has 11 and 3" in outcomes[0].error


def test_originals_combine_with_each_other_and_not_with_ours(tmp_path: Path) -> None:
    names = (HOPPER, "hopper-massinc_200_torsogeom")
    archive = open_archive(original_archive.write_archive(tmp_path / "archive", names, 2))
    ids = [outcome.dataset_id for outcome in import_archive(archive, archive.variants, Import())]
    ids += [recollect(archive, archive.variants[0], Import(episodes=2)).dataset_id]
    collection = combine_datasets(ids, "imujoco-original/hopper-some-v0")
    assert collection.total_episodes == 6
    assert verify("imujoco-original/hopper-some-v0") == []
    env = collection.recover_environment()
    for name, mass in zip(names, (0.75, 1.0), strict=True):
        env.reset(options={"variant": name}, seed=0)
        current = env.unwrapped._current.model  # type: ignore[attr-defined]
        assert current.body("leg").mass[0] == pytest.approx(2.7814 * mass, abs=1e-3)
    env.close()
    assert run(["publish", "hopper-base", "--tier", "random", "--episodes", "1", "--json"]) == 0
    with pytest.raises(DatasetError, match="is not from the original's archive, but other sources are"):
        combine_datasets([*ids, "imujoco/hopper-base-random-v0"], "imujoco/hopper-mixed-v0")


def test_published_originals_are_a_catalogue_of_their_own(place: Path, root: Path) -> None:
    assert published_models() == {}
    archive = open_archive(place)
    list(import_archive(archive, archive.variants, Import()))
    models = published_models()
    assert [str(variant) for variant in models] == [HOPPER, ODD]
    assert models[archive.variants[0]] == archive.mjcf(archive.variants[0])[1]


def test_import_archive_tells_what_it_did(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "xml" / "readme.txt").write_text("hello")
    assert run(["import-archive", str(place)]) == 0
    captured = capsys.readouterr()
    assert captured.out.count("published imujoco-original/") == 2
    assert "published 2, failed 0" in captured.err
    assert "left out 1 file not named after a variant: xml/readme.txt" in captured.err
    assert run(["import-archive", str(place), HOPPER, "--json"]) == 0
    (outcome,) = json.loads(capsys.readouterr().out)
    assert outcome["created"] is False
    assert run(["import-archive", str(place), "hopper-massdec_25_legeom"]) == 2
    assert "did you mean 'hopper-massdec_25_leggeom'" in capsys.readouterr().err
    assert run(["import-archive", str(place), "--robot", "halfcheetah"]) == 2
    (place / "xml" / f"{ODD}.xml").unlink()
    assert run(["import-archive", str(place), "--recollect", "--episodes", "1"]) == 2
    assert f"has no xml/{ODD}.xml" in capsys.readouterr().err


def test_an_unsure_import_asks_for_columns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = str(original_archive.write_archive(tmp_path / "archive", (HOPPER,), 4, ("odd", "done")))
    assert run(["import-archive", place]) == 1
    assert "State them with --columns" in capsys.readouterr().err
    assert run(["import-archive", place, "--columns", "observation,action,skip,done"]) == 0
    found = metadata(f"imujoco-original/{HOPPER}-v0")
    assert found["source_columns"] == "observation,action,skip:1,done"
    assert "no rewards: they are simulated" in str(found["description"])


def test_diff_catalogue_shows_departures(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["diff-catalogue", str(place)]) == 0
    out = capsys.readouterr().out
    assert f"{ODD}, which our catalogue lacks, against walker2d-base" in out
    assert "friction of foot_left_geom on floor   1.9      0.95" in out
    assert "models: 2 compared, 1 as ours, 1 different, 0 unreadable" in out
    assert "ids: 1 in both catalogues, 1 only in the original's, 153 only in ours" in out
    assert run(["diff-catalogue", str(place), "--robot", "hopper", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert [departure["differences"] for departure in shown["departures"]] == [[]]
    (place / "xml" / f"{HOPPER}.xml").write_text("<mujoco/>")
    assert run(["diff-catalogue", str(place)]) == 1
    captured = capsys.readouterr()
    assert "1 unreadable" in captured.out
    assert "is no hopper" in captured.err


def test_diff_catalogue_without_an_archive_takes_what_is_published(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["diff-catalogue"]) == 2
    assert "no dataset of the original is published here" in capsys.readouterr().err
    assert run(["import-archive", str(place), "--json"]) == 0
    capsys.readouterr()
    assert run(["verify", f"imujoco-original/{HOPPER}-v0"]) == 0
    assert "sound, but not replayed: it was imported without seeds" in capsys.readouterr().out
    assert run(["diff-catalogue"]) == 0
    assert "models: 2 compared, 1 as ours, 1 different" in capsys.readouterr().out
