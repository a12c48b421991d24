"""The crash campaign: every command killed, or failed, at every change that it makes to the Minari root.

Run by scripts/test-crash, which preloads faults.c. Each trial forks a process that has everything
imported, lets one file-system call go wrong, looks at what stock Minari sees then, and runs the command
again. kills.py stops the real command line, at random moments.
"""

from __future__ import annotations

import argparse
import ctypes
import errno
import json
import os
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import minari

from imujoco_minari.errors import ImujocoError
from imujoco_minari.policies.references import random_evaluation
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.storage import transactions
from imujoco_minari.variants import Variant
from imujoco_minari.verification import inspect

A, B = "imujoco/hopper-base-random-v0", "imujoco/hopper-massdec_25_leggeom-random-v0"
ALL = "imujoco/hopper-both-random-v0"
DONE, REFUSED, BROKEN = 0, 3, 4
MODES = {
    "SIGKILL": (0, 0),
    "ENOSPC": (errno.ENOSPC, 1),
    "EIO": (errno.EIO, 0),
    "EACCES": (errno.EACCES, 0),
}


def _publish(variant: str, *, force: bool = False, seed: int = 0) -> None:
    publish(variant, tier="random", episodes=2, seed=seed, force=force)


def _nothing() -> None:
    pass


def _sources() -> None:
    _publish("hopper-base")
    _publish("hopper-massdec_25_leggeom")


def _collection() -> None:
    _sources()
    combine_datasets([A], ALL)


@dataclass(frozen=True)
class Scenario:
    """A command, what is there before it, and the dataset that it makes."""

    prepare: Callable[[], None]
    act: Callable[[], object]
    target: str


SCENARIOS = {
    "publish": Scenario(_nothing, lambda: _publish("hopper-base"), A),
    "publish --force": Scenario(_sources, lambda: _publish("hopper-base", force=True, seed=1), A),
    "combine": Scenario(_sources, lambda: combine_datasets([A, B], ALL), ALL),
    "combine --link --force": Scenario(
        _collection, lambda: combine_datasets([A, B], ALL, link=True, force=True), ALL
    ),
}


@dataclass
class Tally:
    """What the trials came to."""

    trials: Counter[str] = field(default_factory=Counter)
    outcomes: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)


def visible(root: Path) -> dict[str, str]:
    """Return the digest of each dataset that stock Minari lists; raise when one is not whole and sound."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        listed = minari.list_local_datasets()
    digests = {}
    for dataset_id, metadata in listed.items():
        dataset = minari.load_dataset(dataset_id)
        assert sum(1 for _ in dataset.iterate_episodes()) == metadata["total_episodes"]
        findings = inspect(root / dataset_id / "data", replay_episodes=0)
        assert not findings, f"{dataset_id}: {findings[0]}"
        digests[dataset_id] = str(metadata.get("content_sha256", metadata["file_sha256"]))
    for file in (root / "imujoco").rglob(transactions.NAMESPACE_FILE):
        json.loads(file.read_text())
    return digests


def in_child(act: Callable[[], object], root: Path, at: int = -1, mode: str = "EIO") -> tuple[int, str]:
    """Run ``act`` in a forked process whose ``at``-th change to the root goes wrong; return its end."""
    message, output = os.pipe()
    pid = os.fork()
    if pid == 0:
        status = BROKEN
        try:
            os.close(message)
            if at >= 0:
                code, sticky = MODES[mode]
                os.environ |= {
                    "FAULTS_BELOW": str(root),
                    "FAULTS_AT": str(at),
                    "FAULTS_ERRNO": str(code),
                    "FAULTS_STICKY": str(sticky),
                }
                ctypes.CDLL(None).faults_start()
            act()
            status = DONE
        except ImujocoError as error:
            os.write(output, str(error).encode()[:4000])
            status = REFUSED
        except BaseException:
            os.write(output, traceback.format_exc().encode()[-4000:])
        finally:
            os._exit(status)
    os.close(output)
    with os.fdopen(message, "rb") as stream:
        text = stream.read().decode("utf-8", "replace")
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), text


def count_calls(scenario: Scenario, root: Path, scratch: Path) -> int:
    os.environ["FAULTS_COUNT"] = str(scratch / "count")
    status, text = in_child(scenario.act, root, 0)
    assert status == DONE, text
    return int((scratch / "count").read_text().split()[0])


def faults(name: str, scenario: Scenario, scratch: Path, every: int, tally: Tally) -> None:
    """Let each call of a scenario go wrong in each way, and check what is there then and after a rerun."""
    root = scratch / "root"
    os.environ["MINARI_DATASETS_PATH"] = str(root)
    fresh(root)
    root.mkdir()
    status, text = in_child(scenario.prepare, root)
    assert status == DONE, text
    pristine = scratch / "pristine"
    shutil.rmtree(pristine, ignore_errors=True)
    shutil.copytree(root, pristine)
    before = visible(root)
    calls = count_calls(scenario, root, scratch)
    after = visible(root)
    print(f"{name}: {calls} calls change the root", flush=True)
    for at in range(1, calls + 1, every):
        for mode in MODES:
            fresh(root, pristine)
            status, text = in_child(scenario.act, root, at, mode)
            where = f"{name}, {mode} at call {at} ({(scratch / 'count').read_text().strip()})"
            tally.trials[mode] += 1
            tally.outcomes[f"{mode}: {describe(status)}"] += 1
            try:
                assert status in (DONE, REFUSED, -signal.SIGKILL), f"ended with {status}: {text}"
                now = visible(root)
                assert set(before) <= set(now), f"lost {set(before) - set(now)}"
                for dataset_id, digest in now.items():
                    assert digest in (before.get(dataset_id), after[dataset_id]), f"{dataset_id} is neither"
                made = now.get(scenario.target) == after[scenario.target]
                assert status != DONE or made, "said that it was done, and was not"
                status, text = in_child(scenario.act, root)
                assert status == DONE, f"the next run ended with {status}: {text}"
                assert visible(root) == after, "the next run made something else"
                left = list((root / transactions.STAGING).glob("*")) + list(root.rglob(".namespace*"))
                assert not left, f"left behind: {left}"
            except Exception as error:
                tally.failures.append(f"{where}: {type(error).__name__}: {error}")
                print("FAILED", tally.failures[-1], flush=True)


def describe(status: int) -> str:
    return {DONE: "done", REFUSED: "refused", -signal.SIGKILL: "killed"}.get(status, "broken")


def fresh(root: Path, source: Path | None = None) -> None:
    shutil.rmtree(root, ignore_errors=True)
    if source is not None:
        shutil.copytree(source, root, symlinks=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--every", type=int, default=1, help="let every n-th call go wrong only")
    parser.add_argument("--only", choices=SCENARIOS, help="one scenario")
    options = parser.parse_args()
    tally = Tally()
    start = time.monotonic()
    # Measured once for all trials, whose processes fork from this one.
    for variant in ("hopper-base", "hopper-massdec_25_leggeom"):
        random_evaluation(Variant.parse(variant))
    with tempfile.TemporaryDirectory() as folder:
        for name, scenario in SCENARIOS.items():
            if options.only in (None, name):
                faults(name, scenario, Path(folder), options.every, tally)
    for title, counter in (("trials", tally.trials), ("outcomes", tally.outcomes)):
        print(title, ", ".join(f"{key}: {value}" for key, value in sorted(counter.items())))
    trials = sum(tally.trials.values())
    print(f"{trials} trials in {time.monotonic() - start:.0f} s, {len(tally.failures)} failed")
    sys.exit(bool(tally.failures))


if __name__ == "__main__":
    main()
