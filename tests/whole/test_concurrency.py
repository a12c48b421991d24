"""Many processes in one Minari root at once: one winner an id, nothing lost, nothing half to be seen."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import minari
import pytest
from minari import namespace

from imujoco_minari.storage import transactions

# Each worker commits to ids of its own and of all; readers list the root meanwhile.
WORKERS = """
import json, multiprocessing, random, sys, warnings
import minari
from imujoco_minari.storage import transactions
from imujoco_minari.errors import DatasetExistsError

def put(dataset_id, mark, replace):
    with transactions.staging(dataset_id) as folder:
        data = folder / "dataset" / "data"
        data.mkdir(parents=True)
        metadata = {"dataset_id": dataset_id, "mark": mark, "pad": "x" * 9000}
        (data / "metadata.json").write_text(json.dumps(metadata))
        (data / "twin.json").write_text(json.dumps(mark))
        transactions.commit(folder / "dataset", dataset_id, replace=replace)

def write(worker, queue):
    rng, won = random.Random(worker), []
    for turn in range(25):
        own = f"own{worker}/a/x{turn}-v0"
        dataset_id = rng.choice(["shared/one/x-v0", "shared/one/y-v0", "shared/two/z-v0", own])
        replace = rng.random() < 0.5 and not dataset_id.startswith("own")
        try:
            put(dataset_id, [worker, turn], replace)
            won.append((dataset_id, replace))
        except DatasetExistsError:
            pass
    queue.put(won)

def read(stop, queue):
    warnings.simplefilter("error")
    seen, lists = set(), 0
    while not stop.is_set():
        now = set(minari.list_local_datasets())
        assert seen <= now, f"lost {seen - now}"
        seen, lists = now, lists + 1
    queue.put(lists)

if __name__ == "__main__":
    context = multiprocessing.get_context("fork")
    queue, counts, stop = context.Queue(), context.Queue(), context.Event()
    reader = context.Process(target=read, args=(stop, counts), daemon=True)
    writers = [context.Process(target=write, args=(worker, queue), daemon=True) for worker in range(6)]
    for process in (reader, *writers): process.start()
    won = [queue.get(timeout=60) for _ in writers]
    for process in writers: process.join()
    stop.set()
    reader.join()
    assert not any(process.exitcode for process in (reader, *writers))
    print(json.dumps({"won": won, "lists": counts.get(timeout=5)}))
"""


def test_many_writers_and_a_reader(root: Path) -> None:
    done = subprocess.run([sys.executable, "-c", WORKERS], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    won = [tuple(win) for wins in result["won"] for win in wins]
    first_wins = [dataset_id for dataset_id, replaced in won if not replaced]
    assert len(first_wins) == len(set(first_wins)), "two processes were told that they made the same id"
    assert set(minari.list_local_datasets()) == {dataset_id for dataset_id, _ in won}
    for dataset_id in minari.list_local_datasets():
        data = root / dataset_id / "data"
        twin = json.loads((data / "twin.json").read_text())
        assert json.loads((data / "metadata.json").read_text())["mark"] == twin
    for name in namespace.list_local_namespaces():
        assert namespace.get_namespace_metadata(name) == {}
    assert result["lists"] > 0
    assert not (root / transactions.STAGING).exists()
    assert not list(root.rglob(".*"))


def test_a_folder_that_another_process_has_locked_meanwhile_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, lock = transactions._make_locked_folder(tmp_path, "")
    remove = shutil.rmtree

    def overtaken(path: Path, *, ignore_errors: bool) -> None:
        if path != folder:
            return
        # The lock is removed. Before the folder is, another process makes a lock of its own.
        monkeypatch.setattr(shutil, "rmtree", remove)
        (path / "lock").unlink()
        (path / "lock").write_text("theirs", "utf-8")

    monkeypatch.setattr(shutil, "rmtree", overtaken)
    transactions._discard(folder, lock)
    assert (folder / "lock").read_text("utf-8") == "theirs"


def test_two_publishers_of_one_id(root: Path) -> None:
    words = ("publish", "hopper-base", "-t", "random", "-n", "2", "--json")
    publish = [sys.executable, "-m", "imujoco_minari", *words]
    racing = [
        subprocess.Popen(publish, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(2)
    ]
    outputs = [(process.communicate(timeout=120), process.returncode) for process in racing]
    assert [code for _, code in outputs] == [0, 0], outputs
    results = [json.loads(out)[0] for (out, _), _ in outputs]
    assert sum(result["created"] for result in results) == 1
    assert len({result["content_sha256"] for result in results}) == 1
    assert set(minari.list_local_datasets()) == {"imujoco/hopper-base-random-v0"}
    assert not (root / transactions.STAGING).exists()
