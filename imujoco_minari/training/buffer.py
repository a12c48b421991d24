"""The replay buffer: transitions, the oldest replaced first."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from imujoco_minari.policies import Array


class ReplayBuffer:
    """At most ``size`` transitions as float32 arrays. The other arguments are the lengths of a row.

    An input of the policy is observation and context.
    """

    def __init__(self, size: int, inputs: int, observations: int, actions: int) -> None:
        widths = {"inputs": (inputs,), "following": (observations,), "actions": (actions,)}
        shapes = widths | {"rewards": (), "dones": ()}
        # The context does not change within an episode, so `following` is the observation alone.
        self._arrays = {name: np.zeros((size, *shape), np.float32) for name, shape in shapes.items()}
        self._size, self._count, self._observations = size, 0, observations

    def add(self, **rows: Array) -> None:
        """Add transitions: inputs, following, actions (in [-1, 1]), rewards and dones, a row for each."""
        count = len(rows["rewards"])
        at = np.arange(self._count, self._count + count) % self._size
        for name, array in self._arrays.items():
            array[at] = rows[name]
        self._count += count

    def sample(self, rng: np.random.Generator, count: int, gamma: float) -> Any:
        """Return transitions drawn evenly, in the form of SBX."""
        from sbx.common.type_aliases import ReplayBufferSamplesNp

        at = rng.integers(min(self._count, self._size), size=count)
        inputs, following = self._arrays["inputs"][at], self._arrays["following"][at]
        return ReplayBufferSamplesNp(
            inputs,
            self._arrays["actions"][at],
            np.concatenate([following, inputs[:, self._observations :]], axis=1),
            self._arrays["dones"][at],
            self._arrays["rewards"][at],
            np.full(count, gamma, np.float32),
        )

    def state(self) -> dict[str, Array]:
        """Return the transitions and their number as arrays."""
        filled = min(self._count, self._size)
        return {name: array[:filled] for name, array in self._arrays.items()} | {
            "count": np.array(self._count)
        }

    def restore(self, state: Mapping[str, Array]) -> None:
        """Restore what :meth:`state` returned."""
        self._count = int(state["count"])
        for name, array in self._arrays.items():
            array[: len(state[name])] = state[name]
