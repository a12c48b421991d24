"""`verify` finds every kind of damage, and outlives every kind of file."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from imujoco_minari.errors import ArgumentError, DatasetError, DatasetNotFoundError
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.storage.metadata import complete_metadata
from imujoco_minari.verification import Finding, Findings, child_process, inspect, verify

ID = "imujoco/hopper-base-random-v0"
EPISODES = 3


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Minari root with two sound datasets, a collection of them, and a linked one."""
    root = tmp_path_factory.mktemp("published")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        ids = [
            publish(variant, tier="random", episodes=EPISODES).dataset_id
            for variant in ("hopper-base", "hopper-massdec_25_leggeom")
        ]
        combine_datasets(ids, "imujoco/hopper-both-v0")
        combine_datasets(ids, "imujoco/hopper-linked-v0", link=True)
    return root


@pytest.fixture
def data(published: Path, root: Path) -> Path:
    """The ``data`` folder of a sound dataset that a test may damage."""
    shutil.copytree(published, root)
    return root / ID / "data"


def reseal(data: Path) -> None:
    """Make all digests right again, as one who tampers would."""
    with h5py.File(file_format.main_file(data), "a") as file:
        for name in file:
            if isinstance(file[name], h5py.Group):
                file_format.seal_episode(file[name])
        digest = file_format.content_sha256(file, len(file))
        file.attrs["content_sha256"] = digest
    rewrite(data, content_sha256=digest)


def rewrite(data: Path, **changes: Any) -> None:
    """Change what metadata.json says, and seal it again."""
    path = data / "metadata.json"
    metadata = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in metadata.items() if value is not ...}))
    complete_metadata(data, {})


def found(data: Path, **options: Any) -> str:
    return "\n".join(map(str, inspect(data, **options)))


class TestSound:
    @pytest.mark.parametrize("name", [ID, "imujoco/hopper-both-v0", "imujoco/hopper-linked-v0"])
    def test_nothing_is_found(self, data: Path, name: str) -> None:
        assert inspect(minari_root.dataset_folder(name) / "data") == []

    def test_the_whole_way_through_the_child_process(self, data: Path) -> None:
        seen: list[None] = []
        assert verify(ID, on_episode=lambda: seen.append(None)) == []
        assert len(seen) == EPISODES

    def test_a_dataset_under_another_id(self, data: Path, root: Path) -> None:
        shutil.copytree(data.parent, root / "imujoco/renamed-v0")
        assert "not 'imujoco/renamed-v0', its place" in str(verify("imujoco/renamed-v0", replay=False)[0])

    def test_no_dataset(self, data: Path, root: Path) -> None:
        (root / "afile").touch()
        for name in ("imujoco/none-v0", "afile/x-v0"):
            with pytest.raises(DatasetNotFoundError, match=f"{name} is not in the Minari root"):
                verify(name)

    @pytest.mark.parametrize("jobs", ["2", 0, None])
    def test_a_wrong_number_of_jobs(self, data: Path, jobs: Any) -> None:
        with pytest.raises(ArgumentError, match="jobs must be a whole number of at least 1, not "):
            verify(ID, jobs=jobs)


class TestDamage:
    """What time, disks and transfers do: the digests are not made right again."""

    @pytest.mark.parametrize("name", ["metadata.json", "main_data.hdf5"])
    def test_a_missing_file(self, data: Path, name: str) -> None:
        (data / name).unlink()
        assert found(data) == f"{name}: is missing"

    @pytest.mark.parametrize("name", ["metadata.json", "main_data.hdf5"])
    @pytest.mark.parametrize("kept", [0.0, 0.1, 0.5, 0.9, 0.999])
    def test_truncation(self, data: Path, name: str, kept: float) -> None:
        path = data / name
        os.truncate(path, int(path.stat().st_size * kept))
        assert found(data, replay_episodes=0)

    @pytest.mark.parametrize("seed", range(60))
    def test_one_flipped_bit_anywhere_in_the_file(self, data: Path, seed: int) -> None:
        flip(file_format.main_file(data), seed)
        assert "main_data.hdf5: has changed since it was published" in found(data, replay_episodes=0)

    @pytest.mark.parametrize("seed", range(60))
    def test_one_flipped_bit_anywhere_in_the_metadata(self, data: Path, seed: int) -> None:
        before = json.loads((data / "metadata.json").read_text())
        flip(data / "metadata.json", seed)
        try:
            same = json.loads((data / "metadata.json").read_text()) == before
        except ValueError:
            same = False
        assert same or found(data, replay_episodes=0)

    def test_bytes_behind_the_end(self, data: Path) -> None:
        with file_format.main_file(data).open("ab") as file:
            file.write(b"\0")
        assert "has changed since it was published" in found(data, replay_episodes=0)

    def test_a_changed_value_is_pinned_to_its_array(self, data: Path) -> None:
        with h5py.File(file_format.main_file(data), "a") as file:
            file["episode_1/observations"][2, 3] += 1e-12
        text = found(data)
        assert "episode_1/observations: does not have the digest" in text
        assert "episode_1/observations[2]: differs from its replay" in text

    def test_noise_is_no_dataset(self, data: Path) -> None:
        file_format.main_file(data).write_bytes(np.random.default_rng(0).bytes(10_000))
        assert "cannot be read" in found(data)


def flip(path: Path, seed: int) -> None:
    raw = bytearray(path.read_bytes())
    bit = int(np.random.default_rng(seed).integers(len(raw) * 8))
    raw[bit // 8] ^= 1 << bit % 8
    path.write_bytes(raw)


def drop_last(file: h5py.File) -> None:
    del file["episode_2"]


def drop_middle(file: h5py.File) -> None:
    del file["episode_1"]


def swap(file: h5py.File) -> None:
    file.move("episode_0", "x")
    file.move("episode_1", "episode_0")
    file.move("x", "episode_1")


def swap_with_ids(file: h5py.File) -> None:
    swap(file)
    for number in (0, 1):
        file[f"episode_{number}"].attrs["id"] = number
        seed = int(file["episode_2"].attrs["seed"])
        file[f"episode_{number}"].attrs["seed"] = seed


def put(path: str, change: Callable[[Any], Any]) -> Callable[[h5py.File], None]:
    def damage(file: h5py.File) -> None:
        values = change(file[path][()])
        del file[path]
        file[path] = values

    return damage


def attribute(path: str, key: str, value: Any) -> Callable[[h5py.File], None]:
    def damage(file: h5py.File) -> None:
        if value is None:
            del file[path].attrs[key]
        else:
            file[path].attrs[key] = value

    return damage


def but(row: int, value: Any) -> Callable[[Any], Any]:
    def change(values: Any) -> Any:
        values[row] = value
        return values

    return change


E0 = "episode_0"
TAMPERED = {
    "last episode missing": (drop_last, "total_episodes"),
    "middle episode missing": (drop_middle, "out of sequence"),
    "an episode too many": (lambda file: file.copy(E0, "episode_3"), "total_episodes"),
    "an episode twice": (lambda file: file.copy(E0, "episode_x"), "out of sequence"),
    "an array at the top": (lambda file: file.create_dataset("episode_3", data=[1.0]), "is no group"),
    "episodes swapped": (swap, "episode_0@id"),
    "episodes swapped, ids mended": (swap_with_ids, "differs from its replay"),
    "no actions": (lambda file: file[E0].pop("actions"), "has no actions"),
    "actions a group": (
        lambda file: (file[E0].pop("actions"), file[E0].create_group("actions")),
        "actions: is no array",
    ),
    "a row short": (put(f"{E0}/observations", lambda v: v[:-1]), "of shape"),
    "a reward too many": (put(f"{E0}/rewards", lambda v: np.append(v, 0.0)), "episode_0/observations"),
    "a column short": (put(f"{E0}/actions", lambda v: v[:, :2]), "of shape"),
    "no column": (put(f"{E0}/observations", lambda v: v[:, 0]), "of shape"),
    "a number for the rewards": (put(f"{E0}/rewards", lambda v: v[0]), "has no steps"),
    "no rewards at all": (put(f"{E0}/rewards", lambda v: v[:0]), "has no steps"),
    "rewards as whole numbers": (put(f"{E0}/rewards", lambda v: v.astype(int)), "not float64"),
    "flags as numbers": (put(f"{E0}/terminations", lambda v: v.astype(float)), "not flags"),
    "observations as text": (put(f"{E0}/observations", lambda v: ["a"] * len(v)), "not numbers or flags"),
    "observation NaN": (put(f"{E0}/observations", but(1, np.nan)), "not finite"),
    "action infinite": (put(f"{E0}/actions", but(1, np.inf)), "not finite"),
    "reward NaN": (put(f"{E0}/rewards", but(1, np.nan)), "not finite"),
    "ended in the middle": (put(f"{E0}/terminations", but(2, True)), "goes on after"),
    "no end": (put(f"{E0}/terminations", but(-1, False)), "ends without"),
    "observation changed": (
        put(f"{E0}/observations", but(1, 0.5)),
        "observations[1]: differs from its replay",
    ),
    "action changed": (put(f"{E0}/actions", but(1, 0.5)), "observations[2]: differs from its replay"),
    "reward changed": (put(f"{E0}/rewards", but(1, 0.5)), "rewards_sum"),
    "end cut off": (
        lambda file: (
            [
                put(f"{E0}/{key}", lambda v: v[:-3])(file)
                for key in file_format.ARRAYS
                if key != "terminations"
            ]
            + [put(f"{E0}/terminations", lambda v: v[3:])(file)]
        ),
        "rewards_sum",
    ),
    "wrong id": (attribute(E0, "id", 7), "episode_0@id"),
    "no id": (attribute(E0, "id", None), "episode_0@id"),
    "id a text": (attribute(E0, "id", "0"), "episode_0@id"),
    "id a list": (attribute(E0, "id", [0, 0]), "episode_0@id"),
    "wrong length": (attribute(E0, "total_steps", 3), "episode_0@total_steps"),
    "no seed": (attribute(E0, "seed", None), "cannot be replayed"),
    "wrong seed": (attribute(E0, "seed", 3), "differs from its replay"),
    "negative seed": (attribute(E0, "seed", -3), "cannot be replayed"),
    "seed a fraction": (attribute(E0, "seed", 0.5), "cannot be replayed"),
    "wrong mean": (attribute(E0, "rewards_mean", 3.0), "rewards_mean"),
    "no maximum": (attribute(E0, "rewards_max", None), "rewards_max"),
    "wrong variant of an episode": (attribute(E0, "variant", "hopper-massinc_50_leggeom"), "episode_0@"),
    "no variant of an episode": (attribute(E0, "variant", None), "not a variant"),
    "variant a path": (attribute(E0, "variant", "../../etc"), "not a variant"),
    "wrong robot": (attribute(E0, "robot", "walker2d"), "of shape"),
    "wrong percent": (attribute(E0, "percent", 25), "episode_0@percent"),
    "wrong tier": (attribute(E0, "tier", "expert"), "episode_0@tier"),
    "wrong variant of the root": (attribute("/", "variant", "hopper-massinc_50_leggeom"), "@variant"),
    "no variant of the root": (attribute("/", "variant", None), "lacks"),
    "another model": (attribute("/", "mjcf", "<mujoco/>"), "@mjcf"),
    "another model's digest": (attribute("/", "mjcf_sha256", "0" * 64), "mjcf_sha256"),
    "soft link": (
        lambda file: (file.pop("episode_2"), file.__setitem__("episode_2", h5py.SoftLink("/episode_0"))),
        "soft link",
    ),
    "soft link within": (
        lambda file: (
            file[E0].pop("rewards"),
            file[E0].__setitem__("rewards", h5py.SoftLink("/episode_1/rewards")),
        ),
        "link to elsewhere",
    ),
    "group within itself": (lambda file: file[E0].__setitem__("self", file[E0]), "self: is no array"),
    "infos that are not empty": (
        lambda file: file[f"{E0}/infos"].__setitem__("x", [1.0]),
        "infos: is no array",
    ),
    "a web of groups": (
        lambda file: [file[f"{E0}"].create_group(f"g{i}") for i in range(200)],
        "more than 100",
    ),
    "reference attribute": (
        lambda file: file[E0].attrs.create("x", file[E0].ref, dtype=h5py.ref_dtype),
        "neither a number nor a text",
    ),
    "compound attribute": (
        lambda file: file[E0].attrs.create("x", np.zeros(2, dtype=[("a", "f8")])),
        "neither a number nor a text",
    ),
    "compressed": (
        lambda file: (
            file[E0].pop("rewards"),
            file[E0].create_dataset("rewards", data=np.zeros(10**6), compression="gzip"),
        ),
        "compressed",
    ),
    "huge claim": (
        lambda file: (
            file[E0].pop("rewards"),
            file[E0].create_dataset("rewards", shape=(10**15,), chunks=(10,), dtype="f8"),
        ),
        "claims more than",
    ),
    "claims more than is stored": (
        lambda file: (
            file[E0].pop("rewards"),
            file[E0].create_dataset("rewards", shape=(1000,), chunks=(10,), dtype="f8"),
        ),
        "claims more values than are stored",
    ),
    "values of another file": (
        lambda file: (
            file[E0].pop("rewards"),
            file[E0].create_dataset("rewards", shape=(4,), dtype="f8", external=[("/etc/hostname", 0, 32)]),
        ),
        "another file",
    ),
    "virtual": (lambda file: (file[E0].pop("rewards"), virtual(file[E0])), "another file"),
}


def virtual(group: h5py.Group) -> None:
    layout = h5py.VirtualLayout(shape=(4,), dtype="f8")
    layout[:] = h5py.VirtualSource("elsewhere.h5", "x", shape=(4,))
    group.create_virtual_dataset("rewards", layout)


class TestTampering:
    """What a person may do who makes the digests right again."""

    @pytest.mark.parametrize("kind", list(TAMPERED))
    def test_it_is_found(self, data: Path, kind: str) -> None:
        damage, finding = TAMPERED[kind]
        with h5py.File(file_format.main_file(data), "a") as file:
            damage(file)
        complete_metadata(data, {})
        try:
            reseal(data)
        except Exception:  # what cannot be sealed is found all the same
            complete_metadata(data, {})
        assert finding in found(data)

    @pytest.mark.parametrize(
        ("key", "value", "finding"),
        [
            ("total_steps", 3, "metadata.json/total_steps"),
            ("total_episodes", "3", "metadata.json/total_episodes"),
            ("total_episodes", True, "metadata.json/total_episodes"),
            ("variant", "hopper-massinc_50_leggeom", "metadata.json/variant"),
            ("robot", ["hopper"], "metadata.json/robot"),
            ("tier", None, "metadata.json/tier"),
            ("content_sha256", "0" * 64, "metadata.json/content_sha256"),
            ("mjcf_sha256", 0, "metadata.json/mjcf_sha256"),
            ("data_format", "arrow", "metadata.json/data_format"),
            ("minari_version", 1, "metadata.json/minari_version"),
            ("dataset_id", {}, "metadata.json/dataset_id"),
            ("observation_space", ..., "Minari would make the environment"),
            ("observation_space", "{}", "not a Box of floats"),
            ("action_space", 7, "not a Box of floats"),
            ("env_spec", ..., "no environment can be recovered"),
            ("env_spec", "[]", "no environment's specification"),
            ("env_spec", "[" * 100_000, "no environment's specification"),
        ],
    )
    def test_metadata(self, data: Path, key: str, value: Any, finding: str) -> None:
        rewrite(data, **{key: value})
        assert finding in found(data, replay_episodes=0)

    @pytest.mark.parametrize("key", ["file_sha256", "metadata_sha256"])
    def test_a_digest_taken_out(self, data: Path, key: str) -> None:
        path = data / "metadata.json"
        metadata = json.loads(path.read_text())
        del metadata[key]
        path.write_text(json.dumps(metadata))
        assert f"metadata.json/{key}: is missing" in found(data, replay_episodes=0)

    @pytest.mark.parametrize(
        ("field", "value", "finding"),
        [
            ("entry_point", "os:system", "not of this package: do not load it"),
            ("entry_point", "imujoco_minari.envs:Walker2dVariantEnv", "as the variant's environment has"),
            ("entry_point", None, "do not load it"),
            ("kwargs", {"variant": "hopper-massinc_50_leggeom"}, "as the variant's environment has"),
            (
                "kwargs",
                {"variant": "hopper-base", "xml_file": "/tmp/x.xml"},
                "as the variant's environment has",
            ),
            ("kwargs", 7, "gives the environment the arguments 7"),
            ("max_episode_steps", 10, "as the variant's environment has"),
            ("vector_entry_point", "os:system", "do not load it"),
            ("additional_wrappers", [{"name": "x", "entry_point": "os:system"}], "do not load it"),
        ],
    )
    def test_an_environment_that_is_not_ours(self, data: Path, field: str, value: Any, finding: str) -> None:
        spec = json.loads(json.loads((data / "metadata.json").read_text())["env_spec"])
        rewrite(data, env_spec=json.dumps(spec | {field: value}))
        assert finding in found(data, replay_episodes=0)

    def test_verify_runs_nothing_that_the_metadata_names(self, data: Path, tmp_path: Path) -> None:
        trace = tmp_path / "trace"
        spec = json.loads(json.loads((data / "metadata.json").read_text())["env_spec"])
        spec |= {"entry_point": "os:system", "kwargs": {"command": f"touch {trace}"}}
        rewrite(data, env_spec=json.dumps(spec), observation_space=...)
        assert "do not load it" in "\n".join(map(str, verify(ID)))
        with pytest.raises(DatasetError, match="do not load it"):
            combine_datasets([ID], "imujoco/hopper-new-v0")
        assert not trace.exists()


class TestLinkedCollections:
    @pytest.fixture
    def linked(self, data: Path, root: Path) -> Path:
        return root / "imujoco/hopper-linked-v0/data"

    def test_a_source_that_is_gone(self, linked: Path, data: Path) -> None:
        shutil.rmtree(data.parent)
        assert "refers to a file that cannot be opened" in found(linked)

    def test_a_source_that_has_fewer_episodes_now(self, linked: Path, data: Path) -> None:
        with h5py.File(file_format.main_file(data), "a") as file:
            del file["episode_1"]
        assert "refers to episode_1 of another dataset, which has no such episode" in found(linked)

    def test_damage_of_a_source(self, linked: Path, data: Path) -> None:
        with h5py.File(file_format.main_file(data), "a") as file:
            file["episode_1/observations"][2, 3] += 1e-12
        assert "episode_1/observations: does not have the digest" in found(linked)

    @pytest.mark.parametrize(
        "target", ["/etc/passwd", "../../../../outside/data/main_data.hdf5", "x.h5", "."]
    )
    def test_a_link_out_of_the_root(self, linked: Path, root: Path, target: str) -> None:
        shutil.copytree(root / ID, root.parent / "outside")
        with h5py.File(file_format.main_file(linked), "a") as file:
            del file["episode_0"]
            file["episode_0"] = h5py.ExternalLink(target, "episode_0")
        complete_metadata(linked, {})
        assert "is no dataset of the Minari root" in found(linked)

    def test_a_staged_link_is_checked_as_it_will_lie(self, linked: Path, data: Path, root: Path) -> None:
        """From the staging folder, the link leads into the root; from its place, out of it."""
        staged = root / ".imujoco-staging" / "x" / "imujoco" / "hopper-linked-v0" / "data"
        shutil.copytree(linked, staged)
        shutil.copytree(root / "imujoco", root / "imujoco" / "imujoco")
        for source in ("hopper-base-random-v0", "hopper-massdec_25_leggeom-random-v0"):
            shutil.copytree(root / "imujoco" / source, staged.parent.parent / source)
        assert found(staged, replay_episodes=0) == ""
        with h5py.File(file_format.main_file(staged), "a") as file:
            del file["episode_0"]
            link = f"../../../../../{ID}/data/main_data.hdf5"
            assert (staged / link).is_file()
            file["episode_0"] = h5py.ExternalLink(link, "episode_0")
        complete_metadata(staged, {})
        assert "is no dataset of the Minari root" in found(staged, replay_episodes=0)

    def test_links_in_a_circle(self, linked: Path, root: Path) -> None:
        with h5py.File(file_format.main_file(linked), "a") as file:
            del file["episode_0"]
            file["episode_0"] = h5py.ExternalLink("../../hopper-linked-v0/data/main_data.hdf5", "episode_0")
        assert found(linked)


class TestReplayBudget:
    """Steps that take for ever."""

    def test_an_episode_whose_steps_are_slow_is_a_finding(
        self, data: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        module = import_module("imujoco_minari.verification.replay")
        monkeypatch.setattr(module, "START_SECONDS", 0.0)
        monkeypatch.setattr(module, "STEP_SECONDS", 1e-7)
        findings = verify(ID)
        assert [finding.where for finding in findings] == [f"episode_{n}" for n in range(EPISODES)]
        assert "was replayed to step 10 only: a step takes more than 1e-07 s" in findings[0].what


class TestScreening:
    """Files that would take the process down."""

    def child(self, monkeypatch: pytest.MonkeyPatch, function: str) -> None:
        monkeypatch.setattr(child_process, "_CHECK", f"limited_calls:{function}")

    def test_a_crash_is_a_finding(self, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.child(monkeypatch, "crash")
        assert [str(f) for f in verify(ID)] == [
            "main_data.hdf5: cannot be read: reading it kills the process (SIGSEGV)"
        ]

    def test_what_kills_the_child_is_told_from_damage(
        self, data: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        self.child(monkeypatch, "crash")
        flip(file_format.main_file(data), 0)
        changed, killed = map(str, verify(ID))
        assert "has changed since it was published" in changed
        assert "SIGSEGV" in killed

    def test_a_crash_beside_a_missing_file(self, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.child(monkeypatch, "crash")
        file_format.main_file(data).unlink()
        assert "SIGSEGV" in str(verify(ID)[0])

    def test_a_hang_is_a_finding(self, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.child(monkeypatch, "compute")
        monkeypatch.setattr(child_process, "_SECONDS", 1)
        monkeypatch.setattr(child_process, "_BYTES_PER_SECOND", 10**12)
        assert "reading it takes more than 1 seconds of processor time" in str(verify(ID)[0])

    def test_a_child_that_says_nothing_is_a_finding(
        self, data: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        self.child(monkeypatch, "nothing")
        assert "gave no answer" in str(verify(ID)[0])

    def test_a_failure_is_a_finding(self, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.child(monkeypatch, "fail")
        assert "reading it fails: ValueError: too much" in str(verify(ID)[0])

    def test_a_smaller_limit_of_the_system_is_no_finding(self, data: Path, root: Path) -> None:
        """As on a cluster with `ulimit -v 6000000`, which is below what a child is given at most."""
        allowed = 6_000_000 * 1024
        assert allowed < child_process.MAX_MEMORY_BYTES
        done = subprocess.run(
            [
                "sh",
                "-c",
                f'ulimit -v {allowed // 1024}; exec "$@"',
                "sh",
                sys.executable,
                "-m",
                "imujoco_minari",
                "verify",
                ID,
            ],
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr


class TestReplacedMeanwhile:
    def test_a_dataset_that_is_replaced_while_it_is_checked_is_checked_again(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        publish("hopper-base", tier="random", episodes=2)
        check, calls = child_process.check_apart, []

        def check_while_replaced(data: Path, *arguments: Any) -> Findings:
            calls.append(data)
            if len(calls) > 1:
                return check(data, *arguments)
            publish("hopper-base", tier="random", episodes=3, force=True)
            return Findings([Finding("metadata.json", "is of one version, and the file of another")])

        monkeypatch.setattr(child_process, "check_apart", check_while_replaced)
        assert verify("imujoco/hopper-base-random-v0") == []
        assert len(calls) == 2

    def test_a_damaged_dataset_is_checked_once(self, monkeypatch: pytest.MonkeyPatch) -> None:
        publish("hopper-base", tier="random", episodes=2)
        calls = []

        def damaged(data: Path, *_: Any) -> Findings:
            calls.append(data)
            return Findings([Finding("main_data.hdf5", "is damaged")], replayable=False)

        monkeypatch.setattr(child_process, "check_apart", damaged)
        assert [finding.what for finding in verify("imujoco/hopper-base-random-v0")] == ["is damaged"]
        assert len(calls) == 1

    def test_a_dataset_that_is_deleted_while_it_is_checked_is_missing(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        published = publish("hopper-base", tier="random", episodes=2)

        def deleted(data: Path, *_: Any) -> Findings:
            shutil.rmtree(published.path)
            return Findings([Finding("main_data.hdf5", "is missing")], replayable=False)

        monkeypatch.setattr(child_process, "check_apart", deleted)
        with pytest.raises(DatasetNotFoundError, match="hopper-base-random-v0"):
            verify("imujoco/hopper-base-random-v0")
