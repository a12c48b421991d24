"""Shared by the offline algorithms with critics: their data, values, updates and target networks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from imujoco_minari.benchmark.networks import (
    HIDDEN,
    Initial,
    Network,
    Update,
    forward,
    iterate,
    new_network,
    padded,
)
from imujoco_minari.loading import Arrays, Statistics
from imujoco_minari.policies import Array
from imujoco_minari.training.agents import import_jax


def transition_data(data: Arrays, statistics: Statistics, reward_scale: float = 1.0) -> tuple[Any, ...]:
    """Return the padded columns of the data, with normalised observations, and the number of rows."""
    columns: tuple[Array, ...] = (
        statistics.normalize(data.observations),
        data.actions,
        data.rewards * reward_scale,
        statistics.normalize(data.next_observations),
        data.terminations,
    )
    return (*map(padded, columns), np.int32(len(data)))


def draw_transitions(key: Any, data: tuple[Any, ...], batch: int) -> tuple[Any, ...]:
    """Return random rows of the columns of :func:`transition_data`, drawn with replacement."""
    *columns, rows = data
    chosen = import_jax().random.randint(key, (batch,), 0, rows)
    return tuple(column[chosen] for column in columns)


def new_critics(observation: int, action: int, seed: int, initial: Initial) -> tuple[Network, Network]:
    """Return two critics with different weights."""
    sizes = (observation + action, *HIDDEN, 1)
    return new_network(sizes, seed + 1000, initial), new_network(sizes, seed + 2000, initial)


def values(critics: tuple[Network, Network], observations: Any, actions: Any) -> tuple[Any, Any]:
    """Return the values (batch,) of actions by both critics."""
    inputs = import_jax().numpy.concatenate((observations, actions), axis=-1)
    first, second = critics
    return forward(first, inputs)[:, 0], forward(second, inputs)[:, 0]


def critic_error(critics: tuple[Network, Network], observations: Any, actions: Any, target: Any) -> Any:
    """Return the sum of both critics' mean squared errors to the target values."""
    first, second = values(critics, observations, actions)
    return ((first - target) ** 2).mean() + ((second - target) ** 2).mean()


def run_updates(
    algorithm: Any, update_of: Callable[[Any], Update], state: Any, data: tuple[Any, ...]
) -> dict[int, Any]:
    """Return the state at each checkpoint of an algorithm, a dataclass with ``seed`` and ``checkpoints``.

    Args:
        algorithm: the algorithm.
        update_of: returns the update of an algorithm's settings.
        state: the state before the first update.
        data: the data of :func:`transition_data`.
    """
    # All seeds use one compiled program.
    update = update_of(replace(algorithm, seed=0, checkpoints=()))
    return iterate(update, state, data, algorithm.checkpoints, algorithm.seed)
