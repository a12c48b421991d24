"""Train cells of offline-v1 with d3rlpy, with the benchmark's hyperparameters, and print both scores.

It runs in an environment with d3rlpy and without this package's dependencies: see scripts/test-offline.
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

import d3rlpy
import numpy as np
import structlog

from imujoco_minari.benchmark import offline
from imujoco_minari.benchmark.evaluating import episode_returns
from imujoco_minari.benchmark.lines import latest, read_lines, references
from imujoco_minari.benchmark.scores import normalised_mean
from imujoco_minari.exporting import to_d3rlpy
from imujoco_minari.loading import arrays
from imujoco_minari.variants import Variant

RESULTS = Path(__file__).parents[2] / "docs" / "results" / offline.FILE


def new_algorithm(method: str, updates: int) -> Any:
    """Return d3rlpy's algorithm of a method with the benchmark's hyperparameters."""
    settings = offline.algorithm_settings(method)
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


def published_scores(method: str, robot: str, tier: str, updates: int) -> list[float]:
    """Return the scores of our lines of these cells on the base robot, one for each seed."""
    lines = latest(read_lines(RESULTS), offline.CELL) if RESULTS.exists() else []
    wanted, base = (method, robot, tier), f"{robot}-base"
    own = [line for line in lines if tuple(line[key] for key in ("method", "robot", "tier")) == wanted]
    found = [(line["results"][base].get(str(updates)), line["references"][base]) for line in own]
    return [normalised_mean(result["returns"], references) for result, references in found if result]


def main() -> None:
    """Train and evaluate each seed, and print the scores beside ours."""
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
    scores = []
    for seed in range(options.seeds):
        d3rlpy.seed(seed)
        algorithm = new_algorithm(options.method, options.updates)
        algorithm.fit(
            data,
            n_steps=options.updates,
            n_steps_per_epoch=max(options.updates // 10, 1),
            logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
            show_progress=False,
        )
        returns = episode_returns(algorithm, base, offline.EVALUATION_EPISODES)
        scores.append(normalised_mean(returns, references(base)))
        print(f"seed {seed}: d3rlpy {scores[-1]:.3f}", flush=True)
    ours = published_scores(options.method, options.robot, options.tier, options.updates)
    shown = f"{np.mean(ours):.3f} (seeds: {len(ours)})" if ours else "not computed"
    print(f"mean: d3rlpy {np.mean(scores):.3f} (seeds: {len(scores)}), here {shown}")


if __name__ == "__main__":
    main()
