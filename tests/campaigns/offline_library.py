"""Train cells of offline-v1 with d3rlpy, with the benchmark's hyperparameters, and print both scores.

It runs in an environment with d3rlpy and without this package's dependencies: see scripts/test-offline.
"""

from __future__ import annotations

import argparse
import logging
import math
from pathlib import Path
from typing import Any

import d3rlpy
import numpy as np
import structlog

from imujoco_minari.benchmark import offline
from imujoco_minari.benchmark.lines import latest, read_lines, references
from imujoco_minari.benchmark.protocol import episode_returns
from imujoco_minari.benchmark.scores import normalised_mean
from imujoco_minari.exporting import to_d3rlpy
from imujoco_minari.loading import arrays
from imujoco_minari.variants import Variant

RESULTS = Path(__file__).parents[2] / "docs" / "results" / offline.FILE


def new_algorithm(method: str, updates: int) -> Any:
    """Return d3rlpy's algorithm of a method with the benchmark's hyperparameters."""
    settings = offline.algorithm_settings(offline.ALGORITHMS[method])
    shared = {
        "batch_size": settings["batch"],
        "gamma": settings["discount"],
        "tau": settings["follow_share"],
        "actor_learning_rate": settings["rate"],
        "critic_learning_rate": settings["rate"],
        "observation_scaler": d3rlpy.preprocessing.StandardObservationScaler(),
    }
    if method == "td3+bc":
        return d3rlpy.algos.TD3PlusBCConfig(
            **shared,
            target_smoothing_sigma=settings["noise"],
            target_smoothing_clip=settings["noise_limit"],
            alpha=settings["weight"],
        ).create()
    falling = d3rlpy.optimizers.CosineAnnealingLRFactory(T_max=updates)
    return d3rlpy.algos.IQLConfig(
        **shared,
        actor_optim_factory=d3rlpy.optimizers.AdamFactory(lr_scheduler_factory=falling),
        expectile=settings["expectile"],
        weight_temp=settings["sharpness"],
        max_weight=settings["weight_limit"],
        reward_scaler=d3rlpy.preprocessing.ReturnBasedRewardScaler(multiplier=1000.0),
    ).create()


def published_scores(method: str, robot: str, tier: str) -> dict[int, list[float]]:
    """Return the scores of our lines of these cells on the base robot: by updates, one for each seed."""
    wanted, base = (method, robot, tier), f"{robot}-base"
    found: dict[int, list[float]] = {}
    for line in latest(read_lines(RESULTS), offline.CELL):
        if tuple(line[key] for key in ("method", "robot", "tier")) == wanted:
            for updates, result in line["results"][base].items():
                score = normalised_mean(result["returns"], line["references"][base])
                found.setdefault(int(updates), []).append(score)
    return found


def main() -> None:
    """Train each seed, evaluate it at the checkpoints, and print the scores beside ours."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="hopper")
    parser.add_argument("--tier", default="medium-expert", choices=offline.TIERS)
    parser.add_argument("--method", default="td3+bc", choices=("td3+bc", "iql"))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--updates", type=int, default=offline.UPDATES)
    options = parser.parse_args()
    # d3rlpy prints its parameters and each epoch.
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    base = Variant(options.robot)
    data = to_d3rlpy(arrays(base.dataset_id(options.tier), dtype=np.float32))
    checkpoints = offline.OfflineGrid(updates=options.updates).checkpoints()
    scores: dict[int, list[float]] = {updates: [] for updates in checkpoints}

    def evaluate(algorithm: Any, epoch: int, updates: int) -> None:
        if updates in scores:
            returns = episode_returns(algorithm, base, offline.EVALUATION_EPISODES)
            scores[updates].append(normalised_mean(returns, references(base)))
            print(f"seed {seed}, {updates:,} updates: d3rlpy {scores[updates][-1]:.3f}", flush=True)

    for seed in range(options.seeds):
        d3rlpy.seed(seed)
        new_algorithm(options.method, options.updates).fit(
            data,
            n_steps=options.updates,
            # Every checkpoint is a whole number of epochs.
            n_steps_per_epoch=math.gcd(*checkpoints),
            epoch_callback=evaluate,
            logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
            show_progress=False,
        )
    ours = published_scores(options.method, options.robot, options.tier)
    for updates, own in scores.items():
        shown = ", ".join(f"{score:.3f}" for score in ours.get(updates, [])) or "not computed"
        print(f"{updates:,} updates: d3rlpy {', '.join(f'{score:.3f}' for score in own)}; here {shown}")


if __name__ == "__main__":
    main()
