"""Disks that fill up, break or refuse, and processes that are killed, at every step of publishing.

`scripts/test-crash` does the same to the whole commands, with faults beneath Python as well.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import minari
import pytest

from imujoco_minari.cli.app import run
from imujoco_minari.errors import ImujocoError, StorageError
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.storage import targets, transactions
from imujoco_minari.storage.targets import new_target

ID = "imujoco/hopper-base-v0"
RANDOM_ID = "imujoco/hopper-base-random-v0"
CALLS = ("mkdir", "rename", "unlink", "rmdir", "open", "fsync", "chmod", "scandir")


class Faults:
    """Lets the ``at``-th file-system call fail; counts the calls."""

    def __init__(self, at: int, code: int) -> None:
        self.at, self.code, self.count = at, code, 0

    def __call__(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            self.count += 1
            if self.count == self.at:
                raise OSError(self.code, os.strerror(self.code), str(args[0]) if args else None)
            return function(*args, **kwargs)

        return call


@contextmanager
def failing(at: int, code: int) -> Iterator[Faults]:
    faults = Faults(at, code)
    with pytest.MonkeyPatch.context() as patch:
        for name in CALLS:
            patch.setattr(os, name, faults(getattr(os, name)))
        patch.setattr(io, "open", faults(io.open))
        patch.setattr(fcntl, "flock", faults(fcntl.flock))
        for module in (transactions, targets):
            patch.setattr(module, "exchange", faults(module.exchange))
        yield faults


def put(mark: str, *, replace: bool = False) -> None:
    with transactions.staging(ID) as folder:
        staged = folder / "dataset"
        (staged / "data").mkdir(parents=True)
        (staged / "data" / "metadata.json").write_text(json.dumps({"dataset_id": ID, "mark": mark}))
        transactions.commit(staged, ID, replace=replace)


def listed() -> dict[str, Any]:
    return {name: metadata["mark"] for name, metadata in minari.list_local_datasets().items()}


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EACCES])
@pytest.mark.parametrize("there", ["nothing", "the old one", "the old one, and no exchange"])
def test_every_call_of_a_commit_that_fails(
    root: Path, code: int, there: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if there.endswith("no exchange"):
        monkeypatch.setattr(transactions, "exchange", lambda source, target: False)
    # The disk's own time is not what is tested, and most of what a commit takes.
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)
    at, ends = 0, set()
    while True:
        at += 1
        shutil.rmtree(root, ignore_errors=True)
        if there != "nothing":
            put("old")
        before = listed()
        with failing(at, code) as faults:
            try:
                put("new", replace=True)
                end = "done"
            except StorageError as error:
                end = str(error).rpartition(": ")[2]
        ends.add(end)
        assert listed() in (before, {ID: "new"}), f"call {at}"
        assert end != "done" or listed() == {ID: "new"}, f"call {at}"
        put("again", replace=True)
        assert listed() == {ID: "again"}
        transactions.tidy()
        assert not list((root / transactions.STAGING).glob("*")), f"call {at} left something behind"
        if faults.count < at:
            break
    assert at > 25
    assert ends == {"done", os.strerror(code)}


def export(mark: str, target: Path) -> None:
    with new_target(target, force=True) as path:
        path.mkdir()
        (path / "a").write_text(mark)
        (path / "b").write_text(mark)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EACCES])
def test_every_call_of_an_export_that_fails(tmp_path: Path, code: int) -> None:
    at, target = 0, tmp_path / "exports" / "folder"
    while True:
        at += 1
        shutil.rmtree(tmp_path / "exports", ignore_errors=True)
        export("old", target)
        with failing(at, code) as faults, contextlib.suppress(StorageError):
            export("new", target)
        marks = {(target / name).read_text() for name in ("a", "b")}
        assert marks in ({"old"}, {"new"}), f"call {at}"
        export("again", target)
        assert [path.name for path in target.parent.iterdir()] == ["folder"], f"call {at}"
        if faults.count < at:
            break
    assert at > 10


def test_an_export_replaces_no_folder_without_an_exchange(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(targets, "exchange", lambda source, target: False)
    target = tmp_path / "folder"
    export("old", target)
    with pytest.raises(StorageError, match="cannot replace a folder in one step; delete it first"):
        export("new", target)
    assert [(target / name).read_text() for name in ("a", "b")] == ["old", "old"]
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_the_same_disk_in_order_gives_no_error() -> None:
    with failing(0, errno.EIO) as faults:
        put("new")
    assert faults.count > 20
    assert listed() == {ID: "new"}


@pytest.mark.parametrize(
    "step", ["publisher.record_shares", "new_dataset.complete_metadata", "new_dataset.inspect"]
)
def test_a_full_disk_while_publishing(step: str, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(*args: Any, **kwargs: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(f"imujoco_minari.publishing.{step}", fill)
    with pytest.raises(StorageError, match="No space left on device"):
        publish("hopper-base", tier="random", episodes=1)
    assert minari.list_local_datasets() == {}
    assert not (root / transactions.STAGING).exists()


def test_a_small_disk(root: Path) -> None:
    """The limit on a file's size is the nearest thing to a full disk that needs no rights."""
    script = (
        "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000))\n"
        "import sys; from imujoco_minari.cli.app import run; import imujoco_minari.cli\n"
        "sys.exit(run(['publish', 'hopper-base', '-t', 'random', '-n', '3']))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert "File too large" in done.stderr
    assert minari.list_local_datasets() == {}
    assert not (root / transactions.STAGING).exists()


KILLED_AT = {
    "rolling out": "imujoco_minari.publishing.new_dataset.complete_metadata",
    "before the rename": "imujoco_minari.storage.transactions.rename_new",
    "after the rename": "imujoco_minari.publishing.new_dataset._read_outcome",
}


@pytest.mark.parametrize("moment", list(KILLED_AT))
def test_killed_and_run_again_the_dataset_is_that_of_an_undisturbed_run(moment: str, root: Path) -> None:
    script = (
        "import os, sys, unittest.mock; from imujoco_minari.publishing.publisher import publish\n"
        "kill = lambda *args, **kwargs: os.kill(os.getpid(), 9)\n"
        "with unittest.mock.patch(sys.argv[1], kill): publish('hopper-base', tier='random', episodes=2)"
    )
    done = subprocess.run([sys.executable, "-c", script, KILLED_AT[moment]], check=False)
    assert done.returncode == -signal.SIGKILL
    visible = minari.list_local_datasets()
    assert set(visible) == ({RANDOM_ID} if moment == "after the rename" else set())
    again = publish("hopper-base", tier="random", episodes=2)
    assert again.created == (not visible)
    assert not (root / transactions.STAGING).exists()
    undisturbed = publish("hopper-base", tier="random", episodes=2, force=True)
    assert again.content_sha256 == undisturbed.content_sha256


def test_force_that_fails_leaves_the_old_one(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old = publish("hopper-base", tier="random", episodes=1)

    def fail(*args: Any, **kwargs: Any) -> list[str]:
        return ["damage"]

    monkeypatch.setattr("imujoco_minari.publishing.new_dataset.inspect", fail)
    with pytest.raises(ImujocoError, match="not published, because its check found: damage"):
        publish("hopper-base", tier="random", episodes=2, force=True)
    monkeypatch.undo()
    os.environ["MINARI_DATASETS_PATH"] = str(root)
    kept = publish("hopper-base", tier="random", episodes=1)
    assert (kept.created, kept.content_sha256) == (False, old.content_sha256)


def test_a_source_that_is_replaced_while_it_is_combined(monkeypatch: pytest.MonkeyPatch) -> None:
    from imujoco_minari.publishing import combiner

    publish("hopper-base", tier="random", episodes=2)
    check = combiner.check_sources

    def replace_then_check(sources: Any) -> None:
        publish("hopper-base", tier="random", episodes=1, seed=1, force=True)
        check(sources)

    monkeypatch.setattr(combiner, "check_sources", replace_then_check)
    with pytest.raises(ImujocoError, match="replaced while it was read"):
        combine_datasets([RANDOM_ID], "imujoco/hopper-new-v0")
    assert set(minari.list_local_datasets()) == {RANDOM_ID}


def test_a_source_that_is_deleted_while_it_is_combined(
    root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from imujoco_minari.publishing import combiner

    publish("hopper-base", tier="random", episodes=2)
    check = combiner.check_sources

    def delete_then_check(sources: Any) -> None:
        minari.delete_dataset(RANDOM_ID)
        check(sources)

    monkeypatch.setattr(combiner, "check_sources", delete_then_check)
    for options in ([], ["--link"]):
        if not (root / RANDOM_ID).exists():
            publish("hopper-base", tier="random", episodes=2)
        assert run(["combine", RANDOM_ID, "--id", "imujoco/hopper-new-v0", *options]) == 1
        told = capsys.readouterr().err
        assert f"{RANDOM_ID} was deleted while it was read" in told
        assert len(told.splitlines()) == 1
    assert minari.list_local_datasets() == {}
