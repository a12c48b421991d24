"""Hyperparameters of a training run of seconds, which still explores, learns and evaluates."""

from __future__ import annotations

from typing import Any

TINY: dict[str, Any] = {
    "search_generations": 0,
    "exploration_steps": 150,
    "evaluate_every": 100,
    "max_steps": 350,
    "settling_from": 1.0,
    "buffer_size": 1000,
    "batch_size": 16,
    "ranking_episodes": 1,
    "choosing_episodes": 2,
    "deciding_episodes": 3,
    "confirming_episodes": 3,
}
