"""Datasets of the expert tier by an actor of random weights, for what needs the ids and not the skill."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from unittest.mock import patch

import numpy as np


def publish_actors(dataset_ids: Iterable[str], root: Path, episodes: int = 8) -> None:
    """Publish these datasets into the Minari root ``root``; those that are there are left alone."""
    from safetensors.numpy import save_file

    from imujoco_minari.publishing.publisher import publish
    from imujoco_minari.variants import parse_dataset_id, specification

    root.mkdir(parents=True, exist_ok=True)
    with patch.dict(os.environ, MINARI_DATASETS_PATH=str(root)):
        for dataset_id in dataset_ids:
            variant, tier = parse_dataset_id(dataset_id)
            weights = root / f"{variant.robot}.safetensors"
            save_file(_weights(*specification(variant.robot).sizes), weights)
            publish(variant, tier=tier, episodes=episodes, policy=weights)
            weights.unlink()


def _weights(observations: int, actions: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    sizes = {
        "latent_pi.0": (64, observations),
        "latent_pi.2": (64, 64),
        "mu": (actions, 64),
        "log_std": (actions, 64),
    }
    weights = {}
    for name, (wide, deep) in sizes.items():
        weights[f"{name}.weight"] = (rng.normal(size=(wide, deep)) / np.sqrt(deep)).astype(np.float32)
        weights[f"{name}.bias"] = np.zeros(wide, np.float32)
    return weights
