"""A policy that infers the body from its own last steps: the imitation counterpart of RMA.

A GRU encodes the last transitions (observation, action) of the episode. The policy takes the observation and
the state of the GRU. Both are cloned together from all training variants.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from hashlib import sha256
from typing import Any

import numpy as np

from imujoco_minari.benchmark.cloning import Pretrained
from imujoco_minari.benchmark.networks import HIDDEN, Loss, Problem, descend, forward, new_network, padded
from imujoco_minari.loading import Arrays, Statistics
from imujoco_minari.policies import LANES, Array
from imujoco_minari.training.agents import import_jax

# Rows whose actions are computed together, where all rows are known.
_ROWS = 512


@dataclass
class History(Pretrained):
    """One policy with a memory of its last steps, cloned from all training variants, then fine-tuned.

    Attributes:
        window: number of transitions that it remembers.
        units: length of the GRU's state.
        sequences: sequences of a batch. Each has ``window + 1`` steps, which are all imitated.
    """

    window: int = 32
    units: int = 64
    sequences: int = 8

    def _problem(self, inputs: Array, train: Arrays) -> Problem:
        jax = import_jax()
        observation, action = inputs.shape[1], train.actions.shape[1]
        cell, state = _cell(self.units), np.zeros((1, self.units), np.float32)
        step = np.zeros((1, observation + action), np.float32)
        networks = {
            "gru": cell.init(jax.random.key(self.seed), state, step),
            "policy": new_network((observation + self.units, *HIDDEN, action), self.seed),
        }
        return sequence_loss(self.sequences, self.window), networks, _columns(inputs, train)

    def adapt(self, demonstrations: Arrays) -> Mapping[int, HistoryPolicy]:
        """Return the policies after each number of steps on the demonstrations."""
        columns = _columns(self._statistics.normalize(demonstrations.observations), demonstrations)
        loss = sequence_loss(self.sequences, self.window)
        found = descend(loss, self._network, columns, self.steps, rate=self.rate, seed=self.seed)
        return {
            steps: HistoryPolicy(networks, self._statistics, self.window) for steps, networks in found.items()
        }


class HistoryPolicy:
    """Acts by the observation and the last transitions of the same episode."""

    algorithm, deterministic = "behaviour cloning", True

    def __init__(self, networks: Any, statistics: Statistics, window: int) -> None:
        self._networks = import_jax().tree.map(import_jax().numpy.asarray, networks)
        self._statistics, self._window = statistics, window
        self._size = statistics.mean.size + len(networks["policy"][-1][1])
        # The transitions of each running episode, the last one at the end, and their number.
        self._episodes: dict[np.random.Generator, tuple[Array, int]] = {}

    @cached_property
    def sha256(self) -> str:
        """Digest of the weights."""
        leaves = import_jax().tree.leaves(self._networks)
        return sha256(b"".join(np.asarray(leaf).tobytes() for leaf in leaves)).hexdigest()

    def act_together(self, observations: Array, rngs: Sequence[np.random.Generator]) -> Array:
        """Return the actions (b, act) for the next observations (b, obs) of b episodes.

        Each episode has random numbers of its own, which name it.
        """
        new = np.zeros((self._window, self._size), np.float32), 0
        known = [self._episodes.get(rng, new) for rng in rngs]
        inputs = self._statistics.normalize(observations).astype(np.float32)
        actions = self._act(inputs, np.array([steps for steps, _ in known]), [count for _, count in known])
        own = np.concatenate((inputs, actions), axis=1)[:, None]
        self._episodes = {
            rng: (np.concatenate((steps[1:], step)), min(count + 1, self._window))
            for rng, (steps, count), step in zip(rngs, known, own, strict=True)
        }
        return actions

    def actions_of(self, data: Arrays) -> Array:
        """Return the actions (N, act) for all observations of some episodes, after the steps of the data."""
        inputs = self._statistics.normalize(data.observations).astype(np.float32)
        steps = np.concatenate((inputs, data.actions.astype(np.float32)), axis=1)
        first = np.repeat(data.episode_starts, data.episode_lengths)
        found = []
        for start in range(0, len(data), _ROWS):
            rows = np.arange(start, min(start + _ROWS, len(data)))
            before = np.maximum(rows[:, None] - np.arange(self._window, 0, -1), 0)
            found.append(self._act(inputs[rows], steps[before], rows - first[rows]))
        return np.concatenate(found)

    def _act(self, inputs: Array, steps: Array, counts: Sequence[int] | Array) -> Array:
        # One compiled program for any number of episodes.
        rows = LANES if len(inputs) <= LANES else _ROWS
        whole = [np.pad(x, [(0, rows - len(x)), *[(0, 0)] * (x.ndim - 1)]) for x in (inputs, steps)]
        counts = np.pad(np.minimum(counts, self._window), (0, rows - len(inputs)))
        return np.asarray(_compiled()(self._networks, *whole, counts))[: len(inputs)]


def encode(gru: Any, steps: Any, known: Any) -> Any:
    """Return the GRU's state after each step (T, B, units), from steps (T, B, obs + act) in order.

    The state passes over a step that is not ``known``, (T, B) bool.
    """
    jax = import_jax()
    units = gru["params"]["hn"]["bias"].shape[0]
    cell = _cell(units)

    def advance(state: Any, now: Any) -> Any:
        step, is_known = now
        following, _ = cell.apply(gru, state, step)
        state = jax.numpy.where(is_known[:, None], following, state)
        return state, state

    _, states = jax.lax.scan(advance, jax.numpy.zeros((steps.shape[1], units)), (steps, known))
    return states


@cache
def sequence_loss(sequences: int, window: int) -> Loss:
    """Return the loss on sequences of steps; its data are (inputs, actions, last rows, rows)."""
    jax = import_jax()
    jnp = jax.numpy

    def loss(networks: Any, key: Any, data: tuple[Any, ...]) -> Any:
        inputs, actions, last, rows = data
        starts = jax.random.randint(key, (sequences,), 0, rows)
        places = starts + jnp.arange(window + 1)[:, None]
        known, chosen = places <= last[starts], jnp.minimum(places, last[starts])
        seen, done = inputs[chosen], actions[chosen]
        states = encode(networks["gru"], jnp.concatenate((seen, done), axis=-1)[:-1], known[:-1])
        before = jnp.concatenate((jnp.zeros_like(states[:1]), states))
        means = jnp.tanh(forward(networks["policy"], jnp.concatenate((seen, before), axis=-1)))
        return (known * ((means - done) ** 2).mean(axis=-1)).sum() / known.sum()

    return loss


def _columns(inputs: Array, data: Arrays) -> tuple[Any, ...]:
    """Return the data of :func:`sequence_loss`."""
    last = np.repeat(data.episode_ends - 1, data.episode_lengths)
    return padded(inputs), padded(data.actions), padded(last, np.int32), len(data)


@cache
def _cell(units: int) -> Any:
    import_jax()
    from flax.linen import GRUCell

    return GRUCell(units)


@cache
def _compiled() -> Any:
    """Return the compiled function (networks, observations, last transitions, their numbers) -> actions."""
    jax = import_jax()
    jnp = jax.numpy

    def act(networks: Any, inputs: Any, steps: Any, counts: Any) -> Any:
        known = jnp.arange(steps.shape[1])[:, None] >= steps.shape[1] - counts
        state = encode(networks["gru"], jnp.moveaxis(steps, 1, 0), known)[-1]
        return jnp.tanh(forward(networks["policy"], jnp.concatenate((inputs, state), axis=-1)))

    return jax.jit(act)
