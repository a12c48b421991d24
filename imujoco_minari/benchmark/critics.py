"""Shared by the offline algorithms with critics: their settings, data, values and training."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from imujoco_minari.benchmark.cloning import robust_statistics
from imujoco_minari.benchmark.networks import (
    HIDDEN,
    Initial,
    Network,
    Update,
    forward,
    iterate,
    new_network,
    new_policy,
    padded,
    to_actor,
)
from imujoco_minari.loading import Arrays
from imujoco_minari.policies import Actor
from imujoco_minari.training.agents import import_jax

# Both critics.
Critics = tuple[Network, Network]


@dataclass(frozen=True)
class ActorCritic(ABC):
    """An algorithm with an actor and two critics.

    Attributes:
        seed: seed of the weights, the batches and the noise.
        checkpoints: numbers of updates after which the policy is kept.
        rate: learning rate.
        batch: rows of a batch.
        discount: discount factor.
        follow_share: share by which a target network follows at each of its updates.
        initial: distribution of the initial weights.
    """

    seed: int
    checkpoints: tuple[int, ...]
    rate: float = 3e-4
    batch: int = 128
    discount: float = 0.99
    follow_share: float = 0.005
    initial: Initial = "pytorch"
    name: ClassVar[str]

    def train(self, data: Arrays) -> dict[int, Actor]:
        """Return the policy at each checkpoint."""
        statistics = robust_statistics(data.observations)
        observation, action = data.observations.shape[1], data.actions.shape[1]
        sizes = (observation + action, *HIDDEN, 1)
        policy = new_policy(data.observations, data.actions, self.seed, self.initial)
        critics = tuple(new_network(sizes, self.seed + more, self.initial) for more in (1000, 2000))
        columns = (
            statistics.normalize(data.observations),
            data.actions,
            data.rewards * self.reward_scale(data),
            statistics.normalize(data.next_observations),
            data.terminations,
        )
        padded_data = (*map(padded, columns), np.int32(len(data)))
        # All seeds use one compiled program.
        update = replace(self, seed=0, checkpoints=()).update()
        state = self.first_state(policy, critics)
        states = iterate(update, state, padded_data, self.checkpoints, self.seed)
        return {
            updates: to_actor(actor.params["network"], statistics, self.name)
            for updates, (actor, *_) in states.items()
        }

    def reward_scale(self, data: Arrays) -> float:
        """Return the factor of the rewards."""
        return 1.0

    @abstractmethod
    def first_state(self, policy: Network, critics: Any) -> Any:
        """Return the state before the first update. Its first part is the learner of the actor."""

    @abstractmethod
    def update(self) -> Update:
        """Return the update of the state, the same function for equal settings."""


def draw_transitions(key: Any, data: tuple[Any, ...], batch: int) -> tuple[Any, ...]:
    """Return random rows, drawn with replacement.

    They are observations, actions, rewards, next observations and terminations.
    """
    *columns, rows = data
    chosen = import_jax().random.randint(key, (batch,), 0, rows)
    return tuple(column[chosen] for column in columns)


def values(critics: Critics, observations: Any, actions: Any) -> tuple[Any, Any]:
    """Return the values (batch,) of actions by both critics."""
    inputs = import_jax().numpy.concatenate((observations, actions), axis=-1)
    first, second = critics
    return forward(first, inputs)[:, 0], forward(second, inputs)[:, 0]


def critic_error(critics: Critics, observations: Any, actions: Any, target: Any) -> Any:
    """Return the sum of both critics' mean squared errors to the target values."""
    first, second = values(critics, observations, actions)
    return ((first - target) ** 2).mean() + ((second - target) ** 2).mean()
