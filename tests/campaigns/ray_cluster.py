"""Publishing and verifying on a real Ray cluster of two nodes; ``scripts/test-ray`` runs it.

Workers are killed, and a whole node goes down. The datasets must be those that one process makes.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

import ray
from ray.cluster_utils import Cluster

from imujoco_minari.errors import JobError
from imujoco_minari.parallel import run_jobs
from imujoco_minari.publishing.publisher import publish_all
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.variants import catalogue
from imujoco_minari.verification import verify

RECIPES = [Recipe(variant, "random", 40) for variant in catalogue("hopper", "joint")]


def where(seconds: float) -> tuple[str, int]:
    """Return on which node, and in which process, a job ran."""
    time.sleep(seconds)
    return ray.get_runtime_context().get_node_id(), os.getpid()


def deadly(task: tuple[int, str]) -> int:
    """Kill the worker the first time that every third job is worked on."""
    number, folder = task
    if number % 3 == 0:
        try:
            (Path(folder) / str(number)).touch(exist_ok=False)
        except FileExistsError:
            return number
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.2)
    return number


def hopeless(number: int) -> int:
    """Kill the worker whenever one job is worked on."""
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def say(what: str, passed: bool) -> None:
    """Report one check, and end the campaign when it failed."""
    print(f"{'passed' if passed else 'FAILED'}: {what}", flush=True)
    if not passed:
        sys.exit(1)


def main() -> None:
    """Run all checks."""
    root = Path(os.environ["MINARI_DATASETS_PATH"])
    alone = {outcome.dataset_id: outcome for outcome in publish_all(RECIPES)}
    for folder in root.iterdir():
        folder.rename(root.parent / f"alone-{folder.name}")

    os.environ.pop("RAY_ADDRESS", None)
    try:
        next(run_jobs(where, [0.0], backend="ray"))
    except JobError as error:
        say("without a cluster, the error has one line", len(str(error).splitlines()) == 1)

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    second = cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    os.environ["RAY_ADDRESS"] = cluster.address

    places = [place for _, place in run_jobs(where, [0.5] * 8, backend="ray") if isinstance(place, tuple)]
    say(f"8 jobs ran on {len({node for node, _ in places})} nodes", len({node for node, _ in places}) == 2)

    with tempfile.TemporaryDirectory() as folder:
        tasks = [(number, folder) for number in range(9)]
        results = sorted(run_jobs(deadly, tasks, backend="ray"))
    say("jobs of killed workers were run again", results == [(number, number) for number in range(9)])
    results = dict(run_jobs(hopeless, range(4), backend="ray"))
    say("a job that kills its worker each time is given up", isinstance(results.pop(2), JobError))
    say("and the others are done", results == {0: 0, 1: 1, 3: 3})

    start = time.monotonic()
    first = {outcome.dataset_id: outcome for outcome in publish_all(RECIPES, backend="ray")}
    say(
        f"{len(first)} datasets published in {time.monotonic() - start:.1f} s into one root",
        all(outcome.created and not outcome.error for outcome in first.values()),
    )
    same = all(first[name].content_sha256 == alone[name].content_sha256 for name in alone)
    say("their content is what one process makes", same)

    # A node goes down in the middle of the work.
    threading.Timer(2.0, lambda: cluster.remove_node(second, allow_graceful=False)).start()
    again = list(publish_all(RECIPES, backend="ray", force=True))
    say("all were published though a node went down", all(not outcome.error for outcome in again))
    same = all(outcome.content_sha256 == alone[outcome.dataset_id].content_sha256 for outcome in again)
    say("and are the same", same)
    findings = [finding for name in alone for finding in verify(name, backend="ray")]
    say("verified through the cluster", not findings)
    leftovers = [path.name for path in root.iterdir() if path.name != "imujoco"]
    say(f"nothing else lies in the root: {leftovers}", leftovers in ([], [".imujoco-staging"]))
    ray.shutdown()
    cluster.shutdown()


if __name__ == "__main__":
    main()
