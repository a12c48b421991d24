"""Publishing and verifying on a Dask cluster of two workers, of which one is killed in the middle.

Run by ``scripts/test-ray``.
"""

from __future__ import annotations

import os
import signal
import sys
import threading

from distributed import Client, LocalCluster

from imujoco_minari.publishing.publisher import publish_all
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.variants import catalogue
from imujoco_minari.verification import verify


def main() -> None:
    """Run all checks."""
    recipes = [Recipe(variant, "random", 40) for variant in catalogue("hopper", "joint")]
    alone = {outcome.dataset_id: outcome.content_sha256 for outcome in publish_all(recipes)}
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, processes=True) as cluster,
        Client(cluster) as client,
    ):
        victim = next(iter(client.run(os.getpid).values()))
        threading.Timer(1.0, os.kill, (victim, signal.SIGKILL)).start()
        outcomes = list(publish_all(recipes, backend="dask", force=True))
        passed = {outcome.dataset_id: outcome.content_sha256 for outcome in outcomes} == alone
        print(
            f"{'passed' if passed else 'FAILED'}: published as one process does, though a worker was killed"
        )
        sound = not any(verify(name, backend="dask") for name in alone)
        print(f"{'passed' if sound else 'FAILED'}: verified through the cluster")
    sys.exit(not (passed and sound))


if __name__ == "__main__":
    main()
