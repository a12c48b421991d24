"""ReBRAC and CQL of d3rlpy as algorithms of the offline benchmark: d3rlpy trains, this package does the rest.

d3rlpy 2.8.1 pins Gymnasium 1.0.0, so it has a virtual environment of its own, whose Python the variable
D3RLPY_PYTHON names (`scripts/test-interop d3rlpy` makes .interop/d3rlpy). It gets the data as a file and
saves its policies as TorchScript. This package reads, evaluates and writes lines like all others:

    D3RLPY_PYTHON=.interop/d3rlpy/bin/python imujoco benchmark offline \\
        --method scripts.offline_d3rlpy:Rebrac --output docs/results/others/rebrac-d3rlpy

Run by d3rlpy's Python as a script, it trains.

Settings follow the papers, with these differences:

- Fewer updates. ReBRAC's paper makes 1,000,000, and CQL's authors report their returns after 500,000.
- Smaller batches: 128 rows, as for all algorithms of the benchmark. ReBRAC has 1,024 on Gym-MuJoCo; an update
  then takes 72 ms of one core. CQL has 256, and three hidden layers; an update then takes 192 ms.
- CQL has two hidden layers, as in d3rlpy's own reproduction.
- Standardised observations, as for all algorithms of the benchmark. The authors' codes take them as they are.
- ReBRAC's penalties of actor and critic are those that its paper tuned on D4RL's data of the same robot and
  tier. They are not tuned on our data.
- CQL has the fixed weight of its authors' command for MuJoCo, without the Lagrange multiplier: 10 for medium
  data and 5 for the others, as d3rlpy's reproduction chooses between the two. The authors' code clones
  behaviour in the actor's first 40,000 updates, and d3rlpy does not.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

LIBRARY = "d3rlpy 2.8.1"
# Of ReBRAC's actor and critic, from the paper's table for Gym-MuJoCo.
PENALTIES = {
    "halfcheetah medium": (0.001, 0.01),
    "halfcheetah medium-replay": (0.01, 0.001),
    "halfcheetah medium-expert": (0.01, 0.1),
    "hopper medium": (0.01, 0.001),
    "hopper medium-replay": (0.05, 0.5),
    "hopper medium-expert": (0.1, 0.01),
    "walker2d medium": (0.05, 0.1),
    "walker2d medium-replay": (0.05, 0.01),
    "walker2d medium-expert": (0.01, 0.01),
}
# Of CQL.
WEIGHTS = {"medium": 10.0, "medium-replay": 5.0, "medium-expert": 5.0}


class _OfD3rlpy:
    """An algorithm of d3rlpy with its own hyperparameters, except for the settings below.

    Args:
        seed: seed of d3rlpy.
        checkpoints: numbers of updates after which the policy is kept.
    """

    config = ""

    def __init__(self, seed: int, checkpoints: tuple[int, ...]) -> None:
        self.seed, self.checkpoints = seed, checkpoints
        self.library, self.batch_size = LIBRARY, 128
        self.hidden_units, self.critic_layer_norm = (256, 256, 256), False
        self.observation_scaler = "standard"

    def tuned(self, robot: str, tier: str) -> dict[str, float]:
        """Return d3rlpy's settings that depend on the dataset."""
        raise NotImplementedError

    def train(self, data: Any) -> dict[int, Any]:
        """Return d3rlpy's policy at each checkpoint, as a torch module."""
        import torch

        # A larger dataset has the settings of the smaller one.
        robot, tier = data.table[0].robot, data.table[0].tier.removesuffix("-large")
        job = vars(self) | {"config": self.config, "tuned": self.tuned(robot, tier)}
        with tempfile.TemporaryDirectory() as folder:
            columns = ("observations", "actions", "rewards", "terminations", "truncations")
            np.savez(Path(folder, "data.npz"), **{name: getattr(data, name) for name in columns})
            Path(folder, "job.json").write_text(json.dumps(job), "utf-8")
            python = os.environ.get("D3RLPY_PYTHON", ".interop/d3rlpy/bin/python")
            own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
            subprocess.run([python, __file__, folder], check=True, env=own)
            return {
                updates: torch.jit.load(str(Path(folder, f"{updates}.pt")), map_location="cpu")
                for updates in self.checkpoints
            }


class Rebrac(_OfD3rlpy):
    """ReBRAC (Tarasov and others, 2023), with the penalties of its paper for the robot and tier."""

    config = "ReBRACConfig"

    def __init__(self, seed: int, checkpoints: tuple[int, ...]) -> None:
        super().__init__(seed, checkpoints)
        self.critic_layer_norm = True
        self.actor_learning_rate = self.critic_learning_rate = 1e-3
        self.penalties = tuple(f"{data}: {actor}, {critic}" for data, (actor, critic) in PENALTIES.items())

    def tuned(self, robot: str, tier: str) -> dict[str, float]:
        """Return the penalties of actor and critic."""
        actor, critic = PENALTIES[f"{robot} {tier}"]
        return {"actor_beta": actor, "critic_beta": critic}


class Cql(_OfD3rlpy):
    """CQL (Kumar and others, 2020), with a fixed weight of its conservative loss."""

    config = "CQLConfig"

    def __init__(self, seed: int, checkpoints: tuple[int, ...]) -> None:
        super().__init__(seed, checkpoints)
        self.hidden_units = (256, 256)
        self.actor_learning_rate, self.critic_learning_rate = 1e-4, 3e-4
        # The weight stays as it is.
        self.alpha_learning_rate = 0.0
        self.n_action_samples = 10
        self.weights = tuple(f"{tier}: {weight}" for tier, weight in WEIGHTS.items())

    def tuned(self, robot: str, tier: str) -> dict[str, float]:
        """Return the weight of the conservative loss."""
        return {"conservative_weight": WEIGHTS[tier]}


def train(folder: Path) -> None:
    """Train by d3rlpy, and save the policy after each number of updates."""
    import logging
    import math

    import d3rlpy
    import structlog
    import torch

    # As many threads as the other algorithms have.
    torch.set_num_threads(1)
    # d3rlpy prints its parameters and each epoch.
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    job = json.loads((folder / "job.json").read_text("utf-8"))
    seed, checkpoints, name = job.pop("seed"), job.pop("checkpoints"), job.pop("config")
    if job.pop("library") != f"d3rlpy {d3rlpy.__version__}":
        raise SystemExit(f"{LIBRARY} is needed, not {d3rlpy.__version__}")
    for stated in ("penalties", "weights"):
        job.pop(stated, None)
    job |= job.pop("tuned")
    encoder, units = d3rlpy.models.VectorEncoderFactory, job.pop("hidden_units")
    job["actor_encoder_factory"] = encoder(units)
    job["critic_encoder_factory"] = encoder(units, use_layer_norm=job.pop("critic_layer_norm"))
    job["observation_scaler"] = d3rlpy.preprocessing.StandardObservationScaler()
    with np.load(folder / "data.npz") as data:
        dataset = d3rlpy.dataset.MDPDataset(
            data["observations"],
            data["actions"],
            data["rewards"].reshape(-1, 1),
            data["terminations"].astype(np.float32),
            (data["truncations"] & ~data["terminations"]).astype(np.float32),
            action_space=d3rlpy.ActionSpace.CONTINUOUS,
        )
    d3rlpy.seed(seed)
    # Without compiled graphs, a GPU is hardly faster than a core.
    gpu = torch.cuda.is_available()
    algorithm = getattr(d3rlpy.algos, name)(**job, compile_graph=gpu).create(gpu)

    def save(algorithm: Any, epoch: int, updates: int) -> None:
        if updates in checkpoints:
            algorithm.save_policy(str(folder / f"{updates}.pt"))

    algorithm.fit(
        dataset,
        n_steps=max(checkpoints),
        # Every checkpoint is a whole number of epochs.
        n_steps_per_epoch=math.gcd(*checkpoints),
        epoch_callback=save,
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
        show_progress=False,
    )


if __name__ == "__main__":
    train(Path(sys.argv[1]))
