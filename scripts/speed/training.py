"""Wall time of training a variant's expert, from the records, against SB3's SAC from scratch."""

from __future__ import annotations

import time
from statistics import median

from imujoco_minari.envs.registration import make
from imujoco_minari.policies import expert_record, expert_variants
from imujoco_minari.variants import BASE
from scripts.speed.measuring import OURS, STOCK, Row

# Number of steps of training from scratch.
STEPS = 1_000_000


def training_row(seconds: float) -> Row:
    """Compare the recorded wall times of experts with the estimated time of a million steps of SB3.

    Args:
        seconds: duration of the measurement of SB3's rate on this machine, after its warm-up.
    """
    from stable_baselines3 import SAC
    from stable_baselines3.common.callbacks import BaseCallback

    records = [expert_record(variant) for variant in expert_variants() if variant.category != BASE]
    if not records:
        raise SystemExit("no trained variants to compare: train some with `imujoco train`")

    class Clock(BaseCallback):
        started: tuple[float, int] | None = None
        rate = 0.0

        def _on_step(self) -> bool:
            if self.num_timesteps < 500:
                return True
            if self.started is None:
                self.started = (time.perf_counter(), self.num_timesteps)
            wall = time.perf_counter() - self.started[0]
            self.rate = (self.num_timesteps - self.started[1]) / max(wall, 1e-9)
            return wall < seconds

    clock = Clock()
    SAC("MlpPolicy", make("hopper-base"), device="cpu", seed=0).learn(STEPS, callback=clock)
    ours = median(float(record["wall_seconds"]) for record in records)
    scratch = STEPS / clock.rate
    return Row(
        f"train a variant's expert, median of {len(records)}",
        {OURS: ours / 60, STOCK: scratch / 60},
        "min",
        {"times less": scratch / ours},
        {"times less": ("least", 20.0)},
        f"recorded wall times; SB3 at {clock.rate:.0f} steps/s, for a million steps",
    )
