"""The settings of a sweep, which are the same for every variant."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from imujoco_minari.policies import policies_folder


def default_state() -> Path:
    """Return the default folder of unfinished runs, beside the user's policies."""
    return policies_folder().parent / "training"


@dataclass(frozen=True)
class Plan:
    """The settings of a sweep.

    Attributes:
        state: folder of the unfinished runs.
        policies: folder of finished policies.
        scratch: train variants from scratch too.
        seed: seed of all that is random.
        target: stop at this score, the mean of mean and lowest return; None for a share of the base expert's
            return.
        changes: hyperparameters that replace those of the file.
        nice: increase of the process's nice value.
        improve: continue the training of finished policies and keep the better ones.
        device: device of the updates: ``cpu``, ``gpu``, or None for JAX's default.
    """

    state: Path = field(default_factory=default_state)
    policies: Path = field(default_factory=policies_folder)
    scratch: bool = False
    seed: int = 0
    target: float | None = None
    changes: dict[str, int | float] = field(default_factory=dict)
    nice: int = 0
    improve: bool = False
    device: str | None = None
