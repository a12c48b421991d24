"""The Minari root: ids that cannot leave it, staging folders, commits, and the tidying of leftovers."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import subprocess
import sys
from pathlib import Path

import minari
import pytest
from hypothesis import given
from hypothesis import strategies as st
from minari import namespace
from minari.dataset.minari_dataset import parse_dataset_id

from imujoco_minari.errors import DatasetError, DatasetExistsError, ImujocoError, StorageError
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.storage import minari_root, transactions

ID = "imujoco/hopper-base-v0"


def stage(folder: Path, mark: str, dataset_id: str = ID) -> Path:
    """Stage what Minari takes for a dataset, with a mark to tell it by."""
    staged = folder / "dataset"
    (staged / "data").mkdir(parents=True)
    (staged / "data" / "metadata.json").write_text(json.dumps({"dataset_id": dataset_id, "mark": mark}))
    return staged


def put(mark: str, dataset_id: str = ID, *, replace: bool = False) -> None:
    with transactions.staging() as folder:
        transactions.commit(stage(folder, mark, dataset_id), dataset_id, replace=replace)


def listed() -> dict[str, str]:
    return {name: str(metadata["mark"]) for name, metadata in minari.list_local_datasets().items()}


def leftovers(root: Path) -> list[str]:
    return sorted(path.name for path in root.rglob(".*"))


def dead_folder(root: Path) -> Path:
    """Leave what a process leaves that dies in its work."""
    code = (
        "import os, sys; from imujoco_minari.storage import transactions\n"
        "with transactions.staging() as folder: print(folder, flush=True); os.kill(os.getpid(), 9)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == -9, done.stderr
    return Path(done.stdout.strip())


class TestIds:
    @pytest.mark.parametrize(
        "dataset_id",
        [
            "",
            "hopper-v0",
            "../hopper-v0",
            "imujoco/../hopper-v0",
            "/imujoco/hopper-v0",
            "imujoco//hopper-v0",
            "imujoco/.hidden-v0",
            ".imujoco-staging/hopper-v0",
            "imujoco/hopper",
            "imujoco/hopper-v0\n",
            "imujoco/hopper-v0\0",
            "imujoco\\hopper-v0",
            "imujoco/hópper-v0",
            "imujoco/" + "a" * 300 + "-v0",
            "imujoco/hopper-v9999999",
            "data/hopper-v0",
            "imujoco/data/hopper-v0",
            "t/hopper-v0",
            None,
            7,
        ],
    )
    def test_what_is_no_id_is_refused(self, dataset_id: object) -> None:
        with pytest.raises(DatasetError, match="malformed dataset id"):
            minari_root.dataset_folder(dataset_id)  # type: ignore[arg-type]

    @given(st.text(max_size=60) | st.from_regex(r"[\w./\\~-]{1,40}-v[0-9]"))
    def test_no_text_names_a_place_outside_the_root(self, text: str) -> None:
        try:
            folder = minari_root.dataset_folder(text)
        except ImujocoError:
            return
        root = minari_root.datasets_root()
        assert root.resolve() in folder.resolve().parents
        assert not any(part.startswith(".") for part in folder.relative_to(root).parts)

    @given(st.from_regex(minari_root._DATASET_ID, fullmatch=True))
    def test_minari_parses_every_id(self, text: str) -> None:
        try:
            minari_root.dataset_folder(text)
        except ImujocoError:
            return
        parse_dataset_id(text)

    def test_a_namespace_of_one_letter_would_break_minaris_listing(self, root: Path) -> None:
        put("sound")
        (root / ID).rename(root / "t-v0")
        (root / "t" / "hopper-v0" / "data").mkdir(parents=True)
        (root / "t-v0" / "data" / "metadata.json").rename(root / "t" / "hopper-v0" / "data" / "metadata.json")
        with pytest.raises(ValueError, match="Malformed dataset ID"):
            minari.list_local_datasets()

    def test_a_namespace_named_data_would_break_minaris_listing(self, root: Path) -> None:
        put("sound")
        (root / "imujoco" / "data").mkdir()
        with pytest.raises(TypeError):
            minari.list_local_datasets()


class TestCommit:
    def test_a_committed_dataset_is_listed_and_leaves_nothing_else(self, root: Path) -> None:
        put("first")
        assert listed() == {ID: "first"}
        assert namespace.list_local_namespaces() == ["imujoco"]
        assert namespace.get_namespace_metadata("imujoco") == {}
        assert leftovers(root) == []

    def test_a_staged_dataset_is_not_listed(self) -> None:
        with transactions.staging() as folder:
            stage(folder, "first")
            assert listed() == {}
        assert listed() == {}

    def test_a_taken_id_is_left_alone(self, root: Path) -> None:
        put("first")
        with pytest.raises(DatasetExistsError, match=r"already exists, at .*; it was not changed"):
            put("second")
        assert listed() == {ID: "first"}
        assert leftovers(root) == []

    def test_replace_puts_the_new_one_in(self, root: Path) -> None:
        put("first")
        put("second", replace=True)
        assert listed() == {ID: "second"}
        assert leftovers(root) == []

    def test_replace_does_not_remove_what_is_no_dataset(self, root: Path) -> None:
        put("inner", "imujoco/hopper-v0/inner-v0")
        with pytest.raises(DatasetExistsError, match="is not a dataset, so it was not replaced"):
            put("outer", "imujoco/hopper-v0", replace=True)
        assert listed() == {"imujoco/hopper-v0/inner-v0": "inner"}

    def test_a_dataset_cannot_lie_within_another(self) -> None:
        put("outer", "imujoco/hopper-v0")
        with pytest.raises(DatasetError, match="within the dataset"):
            put("inner", "imujoco/hopper-v0/inner-v0")
        assert listed() == {"imujoco/hopper-v0": "outer"}

    def test_a_namespaces_description_is_kept(self, root: Path) -> None:
        namespace.create_namespace("imujoco", description="mine")
        put("first")
        assert namespace.get_namespace_metadata("imujoco") == {"description": "mine"}

    def test_others_may_read_what_they_could_read_anywhere(self, root: Path) -> None:
        mask = os.umask(0o022)
        try:
            put("first")
        finally:
            os.umask(mask)
        modes = {path.stat().st_mode & 0o777 for path in root.rglob("*") if path.is_dir()}
        assert modes == {0o755}


class TestRoot:
    def test_a_root_that_is_a_file(self, root: Path) -> None:
        root.write_text("")
        with pytest.raises(StorageError, match="cannot use the Minari root"), transactions.staging():
            pass

    def test_a_staging_folder_that_another_process_removes(
        self, root: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        made, real = [], os.mkdir

        def existed(path: str | Path, *args: int, **kwargs: int) -> None:
            made.append(Path(path))
            if made == [root / transactions.STAGING]:
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
            real(path, *args, **kwargs)

        root.mkdir()
        monkeypatch.setattr(os, "mkdir", existed)
        with transactions.staging() as folder:
            assert folder.parent == root / transactions.STAGING
        assert made.count(root / transactions.STAGING) == 2

    @pytest.mark.parametrize("link", [False, True])
    def test_a_staging_folder_that_is_no_folder(self, root: Path, link: bool) -> None:
        root.mkdir()
        staging = root / transactions.STAGING
        staging.symlink_to(root / "missing") if link else staging.write_text("")
        with pytest.raises(StorageError, match=r"File exists|Not a directory"), transactions.staging():
            pass

    def test_a_namespace_that_is_a_file(self, root: Path) -> None:
        root.mkdir()
        (root / "imujoco").write_text("")
        with pytest.raises(StorageError, match="Not a directory"), transactions.staging(ID):
            pass

    def test_a_read_only_root(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*args: object, **kwargs: object) -> None:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(root))

        monkeypatch.setattr(os, "mkdir", refuse)
        with pytest.raises(StorageError, match="Read-only file system"), transactions.staging():
            pass

    def test_a_namespace_on_another_file_system_is_told_before_the_work(self, root: Path) -> None:
        elsewhere = Path("/dev/shm")
        if not elsewhere.is_dir() or elsewhere.stat().st_dev == root.parent.stat().st_dev:
            pytest.skip("no second file system here")
        root.mkdir()
        (root / "imujoco").symlink_to(elsewhere)
        with pytest.raises(StorageError, match="another file system"), transactions.staging(ID):
            pass

    def test_errors_in_the_work_say_what_could_not_be_written(self, root: Path) -> None:
        with pytest.raises(StorageError, match="No space left"), transactions.staging():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        assert not root.exists() or leftovers(root) == []

    def test_no_home_directory(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail() -> Path:
            raise RuntimeError

        monkeypatch.delenv("MINARI_DATASETS_PATH")
        monkeypatch.setattr(Path, "home", fail)
        with pytest.raises(StorageError, match="MINARI_DATASETS_PATH"):
            minari_root.datasets_root()


class TestTidying:
    def test_a_dead_process_leaves_nothing_to_the_next(self, root: Path) -> None:
        folder = dead_folder(root)
        stage(folder, "half")
        assert listed() == {}
        put("whole")
        assert listed() == {ID: "whole"}
        assert leftovers(root) == []

    @pytest.mark.parametrize("empty", [False, True])
    def test_a_folder_whose_removal_was_cut_short_goes_too(self, root: Path, empty: bool) -> None:
        folder = dead_folder(root)
        if not empty:
            stage(folder, "half")
        (folder / "lock").unlink()
        transactions.tidy()
        assert not folder.exists()

    def test_a_living_process_is_left_alone(self) -> None:
        with transactions.staging() as folder:
            staged = stage(folder, "mine")
            transactions.tidy()
            with transactions.staging():
                pass
            assert (staged / "data" / "metadata.json").exists()
            transactions.commit(staged, ID)
        assert listed() == {ID: "mine"}

    def test_without_locks_nothing_is_taken_for_dead(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*args: object) -> None:
            raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

        monkeypatch.setattr(fcntl, "flock", refuse)
        with transactions.staging() as folder:
            staged = stage(folder, "mine")
            transactions.tidy()
            assert staged.exists()
            transactions.commit(staged, ID)
        assert listed() == {ID: "mine"}


class TestWithoutExchange:
    """Systems that cannot swap two folders in one step."""

    @pytest.fixture(autouse=True)
    def _no_exchange(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(transactions, "exchange", lambda source, target: False)

    def test_replace(self, root: Path) -> None:
        put("old")
        put("new", replace=True)
        assert listed() == {ID: "new"}
        assert leftovers(root) == []

    def test_killed_between_the_steps_the_next_run_puts_the_new_one_in(self, root: Path) -> None:
        put("old")
        folder = dead_folder(root)
        stage(folder, "new")
        (folder / "replacement.json").write_text(json.dumps({"dataset_id": ID, "staged": "dataset"}))
        (root / ID).rename(folder / "replaced")
        transactions.tidy()
        assert listed() == {ID: "new"}
        assert not folder.exists()

    def test_killed_before_the_steps_the_old_one_stands(self, root: Path) -> None:
        put("old")
        folder = dead_folder(root)
        stage(folder, "new")
        (folder / "replacement.json").write_text(json.dumps({"dataset_id": ID, "staged": "dataset"}))
        transactions.tidy()
        assert listed() == {ID: "old"}
        assert not folder.exists()

    @pytest.mark.parametrize("error", [OSError(errno.EIO, "broken"), KeyboardInterrupt()])
    def test_cut_between_the_steps_one_of_the_two_stands(
        self, root: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
    ) -> None:
        put("old")
        rename = Path.rename
        failed = []

        def fail_once(self: Path, target: Path) -> Path:
            if self.name == "dataset" and minari_root.dataset_folder(ID) == target and not target.exists():
                failed.append(self)
                if len(failed) == 1:
                    raise error
            return rename(self, target)

        monkeypatch.setattr(Path, "rename", fail_once)
        with pytest.raises((StorageError, KeyboardInterrupt)):
            put("new", replace=True)
        assert failed
        assert listed() in ({ID: "old"}, {ID: "new"})
        assert leftovers(root) == []

    def test_the_only_copy_is_never_removed(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        put("old")
        rename = Path.rename

        def fail(self: Path, target: Path) -> Path:
            if target == minari_root.dataset_folder(ID):
                raise OSError(errno.EIO if (root / ID).exists() is False else errno.EEXIST, "broken")
            return rename(self, target)

        with monkeypatch.context() as broken:
            broken.setattr(Path, "rename", fail)
            with pytest.raises(StorageError, match="broken"):
                put("new", replace=True)
        assert listed() == {}
        transactions.tidy()
        assert listed() == {ID: "new"}
        assert not (root / transactions.STAGING).exists()


def test_a_staging_folder_that_goes_while_it_is_looked_at_is_made_again(root, monkeypatch):
    glob = Path.glob

    def gone(path, pattern):
        # As the last of the others removes it, between two calls of the operating system.
        if path.name == transactions.STAGING and path.exists():
            path.rmdir()
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
        return glob(path, pattern)

    monkeypatch.setattr(Path, "glob", gone)
    with transactions.staging() as folder:
        assert folder.is_dir()


@pytest.mark.parametrize(("umask", "folders", "files"), [(0o022, 0o755, 0o644), (0o027, 0o750, 0o640)])
def test_a_published_dataset_has_the_modes_that_the_umask_says(
    root: Path, umask: int, folders: int, files: int
) -> None:
    before = os.umask(umask)
    try:
        publish("hopper-base", tier="random", episodes=4, jobs=1)
        if umask == 0o022:
            # Worker processes keep the umask that they were started with, also for a later test.
            publish("hopper-massdec_25_leggeom", tier="random", episodes=4, jobs=2)
    finally:
        os.umask(before)
    made = list(root.rglob("*"))
    assert {path.stat().st_mode & 0o7777 for path in made if path.is_dir()} == {folders}
    assert {path.stat().st_mode & 0o7777 for path in made if path.is_file()} == {files}


def test_every_user_of_a_shared_root_may_stage(root: Path) -> None:
    with transactions.staging("imujoco/x-v0") as folder:
        assert folder.parent.stat().st_mode & 0o7777 == 0o1777
        assert folder.stat().st_mode & 0o7777 == 0o700
    assert not folder.parent.exists()


def test_a_relative_root_is_made_absolute_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", "here/datasets")
    published = publish("hopper-base", tier="random", episodes=2)
    assert published.path == tmp_path / "here" / "datasets" / "imujoco" / "hopper-base-random-v0"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "here" / "datasets"))
    assert minari.load_dataset("imujoco/hopper-base-random-v0").total_episodes == 2
