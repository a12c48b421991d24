"""Behaviour cloning: from scratch, from the base's expert, from all training variants, and of offline data.

Each starts from a network and minimises the squared error to the actions of the data. They differ in where
the network comes from.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from imujoco_minari.benchmark.networks import (
    BATCH,
    Initial,
    Network,
    Problem,
    bind,
    cloning_loss,
    descend,
    new_policy,
    of_actor,
    padded,
    to_actor,
)
from imujoco_minari.benchmark.protocol import STEPS
from imujoco_minari.loading import Arrays, Statistics
from imujoco_minari.loading.statistics import measure
from imujoco_minari.policies import Actor, Array, expert_actor
from imujoco_minari.policies.universal import whole_context
from imujoco_minari.variants import Variant

# An observation that hardly varies in the data says little, but a large number of it would say much.
_LEAST_STD = 0.01


@dataclass
class FineTuned:
    """A method that fine-tunes a policy on the demonstrations.

    Attributes:
        seed: seed of the weights and of the batches.
        rate: learning rate of the fine-tuning.
        steps: numbers of steps of the fine-tuning after which it returns the policy.
    """

    seed: int = 0
    rate: float = 3e-4
    steps: tuple[int, ...] = STEPS


@dataclass
class Scratch(FineTuned):
    """Behaviour cloning of the demonstrations alone, from random weights."""

    steps: tuple[int, ...] = STEPS[1:]

    def adapt(self, demonstrations: Arrays) -> Mapping[int, Actor]:
        """Return the policies after each number of steps on the demonstrations."""
        statistics = robust_statistics(demonstrations.observations)
        network = new_policy(demonstrations.observations, demonstrations.actions, self.seed)
        return fine_tune(network, statistics, demonstrations, self.rate, self.seed, self.steps)


@dataclass
class BaseExpert(FineTuned):
    """The base robot's expert: as it is after 0 steps, then fine-tuned on the demonstrations."""

    def adapt(self, demonstrations: Arrays) -> Mapping[int, Actor]:
        """Return the policies after each number of steps on the demonstrations."""
        size = demonstrations.observations.shape[1]
        expert = expert_actor(Variant.parse(demonstrations.table[0].variant).base)
        raw = Statistics(np.zeros(size), np.ones(size))
        return fine_tune(of_actor(expert), raw, demonstrations, self.rate, self.seed, self.steps)


class Fitted(ABC):
    """A method whose network learns from the training variants.

    Each states its own fields: their order is that of the settings in result lines.
    """

    seed: int
    fit_rate: float
    fit_steps: int
    _network: Any
    _statistics: Statistics

    def fit(self, train: Arrays) -> None:
        """Train the network on the training variants."""
        self._statistics = robust_statistics(train.observations)
        problem = self._problem(self._statistics.normalize(train.observations), train)
        steps = self.fit_steps
        self._network = descend(*problem, [steps], rate=self.fit_rate, seed=self.seed)[steps]

    @abstractmethod
    def _problem(self, inputs: Array, train: Arrays) -> Problem:
        """Return the problem of ``fit``. The inputs are the normalised observations."""


@dataclass
class Pretrained(Fitted, FineTuned):
    """A network that ``fit`` learns from the training variants, and ``adapt`` fine-tunes.

    Attributes:
        fit_rate: learning rate on the training variants.
        fit_steps: steps on the training variants.
    """

    fit_rate: float = 1e-3
    fit_steps: int = 20_000

    def adapt(self, demonstrations: Arrays) -> Mapping[int, Any]:
        """Return the policies after each number of steps on the demonstrations."""
        return fine_tune(self._network, self._statistics, demonstrations, self.rate, self.seed, self.steps)


@dataclass
class MultiVariant(Pretrained):
    """One policy cloned from all training variants: as it is after 0 steps, then fine-tuned.

    Attributes:
        told: give the policy the variant's context beside the observation. Such a policy is not fine-tuned.
    """

    told: bool = False

    def _problem(self, inputs: Array, train: Arrays) -> Problem:
        if self.told:
            told = contexts_of(train).astype(np.float32)[train.variant_index]
            inputs = np.concatenate((inputs, told), axis=1)
        data = (padded(inputs), padded(train.actions), len(inputs))
        return cloning_loss(256), new_policy(inputs, train.actions, self.seed), data

    def adapt(self, demonstrations: Arrays) -> Mapping[int, Actor]:
        """Return the policies after each number of steps on the demonstrations."""
        if not self.told:
            return super().adapt(demonstrations)
        network = bind(self._network, contexts_of(demonstrations)[0].astype(np.float32))
        return {0: to_actor(network, self._statistics, "behaviour cloning")}


@dataclass(frozen=True)
class Cloning:
    """Behaviour cloning of offline data, of all episodes or of those with the highest returns.

    Attributes:
        seed: seed of the weights and of the batches.
        checkpoints: numbers of gradient steps after which the policy is kept.
        best: share of the steps to clone, of the episodes with the highest returns.
        rate: learning rate.
        batch: rows of a batch.
        initial: distribution of the initial weights.
    """

    seed: int
    checkpoints: tuple[int, ...]
    best: float = 1.0
    rate: float = 3e-4
    batch: int = BATCH
    initial: Initial = "pytorch"

    def train(self, data: Arrays) -> dict[int, Actor]:
        """Return the policy at each checkpoint."""
        order = np.argsort(-data.returns, kind="stable")
        steps = np.cumsum(data.episode_lengths[order])
        # At least one episode.
        kept = data.select(np.sort(order[: 1 + np.searchsorted(steps, self.best * len(data))]))
        network = new_policy(kept.observations, kept.actions, self.seed, self.initial)
        statistics = robust_statistics(kept.observations)
        return fine_tune(network, statistics, kept, self.rate, self.seed, self.checkpoints, self.batch)


def fine_tune(
    network: Network,
    statistics: Statistics,
    data: Arrays,
    rate: float,
    seed: int,
    checkpoints: tuple[int, ...],
    batch: int = BATCH,
) -> dict[int, Actor]:
    """Clone data from a given network, and return the policy after each number of steps.

    The network takes observations that ``statistics`` normalise.
    """
    inputs = statistics.normalize(data.observations)
    columns = (padded(inputs), padded(data.actions), len(inputs))
    networks = descend(cloning_loss(batch), network, columns, checkpoints, rate=rate, seed=seed)
    return {steps: to_actor(found, statistics, "behaviour cloning") for steps, found in networks.items()}


def contexts_of(data: Arrays) -> Array:
    """Return the context of each variant of the data: the change of every parameter of its robot."""
    return np.array([whole_context(Variant.parse(origin.variant)) for origin in data.table])


def robust_statistics(observations: Array) -> Statistics:
    """Return the statistics of observations, with standard deviations of at least 0.01."""
    found = measure(observations)
    return Statistics(found.mean, np.maximum(found.std, _LEAST_STD))
