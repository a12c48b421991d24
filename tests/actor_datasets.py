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
            save_file(random_weights(*specification(variant.robot).sizes), weights)
            publish(variant, tier=tier, episodes=episodes, policy=weights)
            weights.unlink()


def random_weights(observations: int, actions: int, width: int = 64, seed: int = 0) -> dict[str, np.ndarray]:
    """Return a SAC actor's arrays, with two hidden layers of ``width`` and random weights."""
    rng = np.random.default_rng(seed)
    sizes = {
        "latent_pi.0": (width, observations),
        "latent_pi.2": (width, width),
        "mu": (actions, width),
        "log_std": (actions, width),
    }
    weights = {}
    for name, (outputs, inputs) in sizes.items():
        weights[f"{name}.weight"] = (rng.normal(size=(outputs, inputs)) / np.sqrt(inputs)).astype(np.float32)
        weights[f"{name}.bias"] = np.zeros(outputs, np.float32)
    return weights
