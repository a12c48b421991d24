"""Round trips through both remotes, with kills in between, read back by stock Minari in another root.

Run by scripts/test-remote. The bucket is the program ``gcp-storage-emulator``; the Hub is
tests/hub_server.py, which speaks the routes that ``huggingface_hub`` calls. What that does not prove: the
Hub's Xet storage, its permissions, rate limits and pages, and Google's authentication.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from hub_server import TOKEN, HubServer

VARIANTS = ("hopper-massdec_25_leggeom", "hopper-base", "hopper-lengthinc_50_thighgeom")
LINKED, COPIED = "imujoco/hopper-linked-v0", "imujoco/hopper-copied-v0"
FILES = ("data/main_data.hdf5", "data/metadata.json")
STOCK = """
import json, sys, minari
ids = json.loads(sys.argv[1])
print(json.dumps(sorted(minari.list_remote_datasets())), file=sys.stderr)
for dataset_id in ids:
    minari.download_dataset(dataset_id)
    dataset = minari.load_dataset(dataset_id)
    assert sum(len(e.rewards) for e in dataset.iterate_episodes()) == dataset.total_steps
assert not any(name.startswith("imujoco") for name in sys.modules), "this was to be stock Minari"
"""
LIST = "import minari, json; print(json.dumps(minari.list_remote_datasets(), default=str))"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--emulator", required=True, help="the program gcp-storage-emulator")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ids = publish(folder / "root", arguments.episodes)
        with emulator(arguments.emulator, folder / "bucket") as settings:
            writes = lambda: sum(path.is_file() for path in (folder / "bucket").rglob("*"))  # noqa: E731
            round_trip(Remote("gcp://datasets", settings, writes), folder, ids, arguments.kills, chance)
        with HubServer() as server:
            settings = {
                "HF_ENDPOINT": server.url,
                "HF_HOME": str(folder / "huggingface"),
                "HF_HUB_DISABLE_XET": "1",
                "HF_HUB_DISABLE_PROGRESS_BARS": "1",
                "HF_HUB_DISABLE_TELEMETRY": "1",
                "HF_TOKEN": TOKEN,
            }
            writes = lambda: sum(r.startswith(("POST", "PUT")) for r in list(server.hub.requests))  # noqa: E731
            round_trip(Remote("hf://user", settings, writes), folder, ids, arguments.kills, chance)


@dataclass(frozen=True)
class Remote:
    """An address, what a client needs to know of it, and how many writes it has seen."""

    address: str
    settings: dict[str, str]
    writes: Callable[[], int]


def imujoco(root: Path, *arguments: str, **settings: str) -> str:
    return python(root, "-m", "imujoco_minari", *arguments, **settings).stdout


def python(root: Path, *arguments: str, **settings: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"MINARI_DATASETS_PATH": str(root)} | settings
    done = subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{arguments} failed:\n{done.stdout}\n{done.stderr}")
    return done


def publish(root: Path, episodes: int) -> list[str]:
    """Publish datasets of random episodes, and two collections of them."""
    imujoco(root, "publish", *VARIANTS, "--tier", "random", "--episodes", str(episodes))
    imujoco(root, "publish", "halfcheetah-lengthinc_50_bthigh", "--tier", "random", "--episodes", "20")
    ids = [f"imujoco/{variant}-random-v0" for variant in VARIANTS]
    imujoco(root, "combine", *ids, "--id", COPIED)
    imujoco(root, "combine", *ids, "--id", LINKED, "--link")
    return [*ids, "imujoco/halfcheetah-lengthinc_50_bthigh-random-v0", COPIED, LINKED]


@contextmanager
def emulator(program: str, folder: Path) -> Iterator[dict[str, str]]:
    """Run the emulator with one bucket, and yield what a client needs to know of it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    command = [program, "-d", str(folder), "start", "--host", "127.0.0.1", "--port", port, "--quiet"]
    command += ["--default-bucket", "datasets"]
    # It reports every client that was killed.
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        time.sleep(5)
        yield {"STORAGE_EMULATOR_HOST": f"http://127.0.0.1:{port}"}
    finally:
        process.terminate()
        process.wait()


def round_trip(remote: Remote, folder: Path, ids: list[str], kills: int, chance: random.Random) -> None:
    """Push with kills, list after each, finish, read back with stock Minari and with ours, compare."""
    root, address, kind = folder / "root", remote.address, remote.address.partition(":")[0]
    settings = remote.settings | {"MINARI_REMOTE": address}
    size = sum((root / dataset_id / name).stat().st_size for dataset_id in ids for name in FILES)
    seen = []
    for _ in range(kills):
        kill_a_push(root, remote, ids, chance)
        listed = json.loads(python(root, "-c", LIST, **settings).stdout)
        for dataset_id, metadata in listed.items():
            assert metadata == json.loads((root / dataset_id / FILES[1]).read_text()), f"{dataset_id} differs"
        seen.append(len(listed))
        if listed:
            stock_reads(folder / f"{kind}-{len(seen)}", root, [sorted(listed)[-1]], settings)
    start = time.monotonic()
    outcomes = json.loads(imujoco(root, "push", *ids, "--remote", address, "--json", **settings))
    print(f"{address}: {kills} kills, after which stock Minari listed {seen} datasets, each of them whole")
    print(
        f"{address}: then {sum(o['uploaded'] for o in outcomes)} of {len(ids)} uploaded, the others there; "
        f"{size / 1e6:.1f} MB in all, in {time.monotonic() - start:.1f} s"
    )
    stock_reads(folder / f"{kind}-stock", root, ids, settings)
    sound = imujoco(folder / f"{kind}-stock", "verify", *ids).count("sound")
    print(f"{address}: stock Minari downloaded {len(ids)}, equal byte for byte; replayed: {sound} sound")
    pulled = json.loads(
        imujoco(folder / f"{kind}-ours", "pull", *ids, "--remote", address, "--json", **settings)
    )
    assert all(outcome["downloaded"] for outcome in pulled)
    compare(folder / f"{kind}-ours", root, ids)
    print(f"{address}: imujoco pull brought {len(pulled)}, equal byte for byte")
    again = json.loads(imujoco(root, "push", *ids, "--remote", address, "--json", **settings))
    assert not any(outcome["uploaded"] for outcome in again)
    print(f"{address}: pushed again, nothing was uploaded")


def kill_a_push(root: Path, remote: Remote, ids: list[str], chance: random.Random) -> None:
    """Start a push and kill it once it has made a few writes, at a random moment after the last of them."""
    environment = os.environ | {"MINARI_DATASETS_PATH": str(root)} | remote.settings
    command = [sys.executable, "-m", "imujoco_minari", "push", *ids, "--remote", remote.address]
    until = remote.writes() + chance.randint(1, 4)
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while process.poll() is None and remote.writes() < until:
        time.sleep(0.002)
    time.sleep(chance.uniform(0, 0.1))
    process.send_signal(signal.SIGKILL)
    process.wait()


def stock_reads(root: Path, original: Path, ids: list[str], settings: dict[str, str]) -> None:
    root.mkdir()
    python(root, "-c", STOCK, json.dumps(ids), **{**settings, "HF_TOKEN": ""})
    compare(root, original, ids)


def compare(ours: Path, theirs: Path, ids: list[str]) -> None:
    for dataset_id in ids:
        for name in FILES:
            digests = {
                hashlib.sha256((root / dataset_id / name).read_bytes()).digest() for root in (ours, theirs)
            }
            assert len(digests) == 1, f"{dataset_id}/{name} differs"


if __name__ == "__main__":
    main()
