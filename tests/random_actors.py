"""Actors with random weights, for tests that need a policy and no skill."""

from __future__ import annotations

from typing import Any

import numpy as np

from imujoco_minari.policies import Actor


def random_actor(
    observations: int = 11, actions: int = 3, widths: tuple[int, ...] = (256, 256), **fields: Any
) -> Actor:
    rng = np.random.default_rng(0)
    weights, size = {}, observations
    for i, width in enumerate(widths):
        weights[f"latent_pi.{2 * i}.weight"] = rng.normal(size=(width, size)).astype(np.float32) / np.sqrt(
            size
        )
        weights[f"latent_pi.{2 * i}.bias"] = rng.normal(size=width).astype(np.float32) / 10
        size = width
    for head in ("mu", "log_std"):
        weights[f"{head}.weight"] = rng.normal(size=(actions, size)).astype(np.float32) / np.sqrt(size)
        weights[f"{head}.bias"] = rng.normal(size=actions).astype(np.float32) / 10
    return Actor(weights, **fields)
