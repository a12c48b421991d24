"""The damage campaign: thousands of broken HDF5 files, each read by `inspect` in a process of its own.

Run by scripts/test-fuzz. Counts what becomes of them: found by what check, and whether reading killed
the process, which `verify` meets by reading in a child process first.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import signal
import tempfile
import time
from collections import Counter
from pathlib import Path

from ending import finish

from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.storage import file_format
from imujoco_minari.verification import inspect

SECONDS = 20
MEMORY = 2**33


def flip(raw: bytearray, rng: random.Random) -> None:
    raw[rng.randrange(len(raw))] ^= 1 << rng.randrange(8)


def flips(raw: bytearray, rng: random.Random) -> None:
    for _ in range(rng.randrange(2, 40)):
        flip(raw, rng)


def extreme(raw: bytearray, rng: random.Random) -> None:
    place, size = rng.randrange(len(raw)), rng.choice((1, 2, 4, 8))
    raw[place : place + size] = rng.choice((b"\0", b"\xff", b"\x7f")) * size


def zero(raw: bytearray, rng: random.Random) -> None:
    place, size = rng.randrange(len(raw)), rng.choice((64, 512, 4096))
    raw[place : place + size] = bytes(len(raw[place : place + size]))


def move(raw: bytearray, rng: random.Random) -> None:
    size = rng.choice((8, 64, 512))
    source, target = rng.randrange(len(raw)), rng.randrange(len(raw))
    raw[target : target + size] = raw[source : source + size]


def aim(raw: bytearray, rng: random.Random) -> None:
    # At something that is there: most eight bytes of structure are addresses or sizes.
    place, target = rng.randrange(len(raw) // 8) * 8, rng.randrange(len(raw) // 8) * 8
    raw[place : place + 8] = target.to_bytes(8, "little")


def cut(raw: bytearray, rng: random.Random) -> None:
    del raw[rng.randrange(len(raw)) :]


def insert(raw: bytearray, rng: random.Random) -> None:
    place = rng.randrange(len(raw))
    raw[place:place] = rng.randbytes(rng.choice((1, 8, 100)))


KINDS = {f.__name__: f for f in (flip, flips, extreme, zero, move, aim, cut, insert)}


def trial(data: Path) -> tuple[str, list[str]]:
    """Inspect a dataset in a forked process; return how that ended and the findings."""
    receiver, sender = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(receiver)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.alarm(SECONDS)
        status = 4
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            found = [str(finding) for finding in inspect(data, replay_episodes=0)]
            os.write(sender, json.dumps(found).encode()[:60_000])
            status = 0
        except BaseException as error:
            os.write(sender, json.dumps([repr(error)[:500]]).encode())
        finally:
            os._exit(status)
    os.close(sender)
    with os.fdopen(receiver, "rb") as stream:
        text = stream.read()
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if code < 0:
        return signal.Signals(-code).name, []
    try:
        found = json.loads(text)
    except ValueError:
        found = ["?"]
    return ("raised" if code else "survived"), found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="a folder for the files that kill or hang the process")
    options = parser.parse_args()
    rng = random.Random(options.seed)
    ends: Counter[str] = Counter()
    quiet: Counter[str] = Counter()
    failures, trials = [], 0
    with tempfile.TemporaryDirectory() as folder:
        os.environ["MINARI_DATASETS_PATH"] = folder
        source = publish("hopper-base", tier="random", episodes=2)
        linked = combine_datasets([source.dataset_id], "imujoco/hopper-linked-v0", link=True)
        assert source.path is not None
        places = [source.path / "data", Path(linked.storage.data_path)]
        assert not any(inspect(place, replay_episodes=0) for place in places)
        sound = {place: file_format.main_file(place).read_bytes() for place in places}
        start = time.monotonic()
        while time.monotonic() - start < options.seconds:
            place = places[0] if rng.random() < 0.85 else places[1]
            kind = rng.choice(list(KINDS))
            raw = bytearray(sound[place])
            KINDS[kind](raw, rng)
            if raw == sound[place]:
                continue
            file_format.main_file(place).write_bytes(raw)
            trials += 1
            end, found = trial(place)
            ends[f"{kind}: {end}"] += 1
            if end == "survived" and len(found) == 1 and "has changed since it was published" in found[0]:
                # No other check sees a difference: unused space, or what the library overlooks.
                quiet[kind] += 1
            if options.keep and end.startswith("SIG"):
                options.keep.mkdir(exist_ok=True)
                (options.keep / f"{end}-{trials}.hdf5").write_bytes(raw)
            if end == "raised" or (end == "survived" and not found):
                failures.append(f"{kind}: {found}")
            file_format.main_file(place).write_bytes(sound[place])
    print("found by the file's digest alone:", dict(quiet))
    finish(f"{trials} damaged files", ends, failures)


if __name__ == "__main__":
    main()
