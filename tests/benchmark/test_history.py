"""A policy with a memory: what it remembers, and that it infers what the observation does not show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_arrays import synthetic

from imujoco_minari.benchmark.history import History, HistoryPolicy
from imujoco_minari.benchmark.protocol import relative_error
from imujoco_minari.loading import Arrays


@pytest.fixture(scope="module")
def hidden() -> Arrays:
    """In each episode the action is always 0.5 or always -0.5, which no observation shows."""
    data = synthetic([12] * 400)
    rng = np.random.default_rng(0)
    sign = np.repeat(np.where(np.arange(400) % 2, 0.5, -0.5), 12)
    actions = np.repeat(sign[:, None], data.actions.shape[1], axis=1).astype(np.float32)
    observations = rng.normal(size=data.observations.shape).astype(np.float32)
    return replace(data, observations=observations, actions=actions)


def trained(data: Arrays, fit_steps: int) -> HistoryPolicy:
    method = History(fit_rate=3e-3, fit_steps=fit_steps, steps=(0, 2), window=4, units=8, sequences=8)
    method.fit(data)
    found = method.adapt(data)
    assert found[0].sha256 != found[2].sha256
    return found[0]


def test_the_body_is_inferred_from_the_last_steps(hidden: Arrays) -> None:
    policy, others = trained(hidden.select(np.arange(300)), 600), hidden.select(np.arange(300, 400))
    error = np.abs(policy.actions_of(others) - others.actions).max(axis=1)
    first = np.isin(np.arange(len(others)), others.episode_starts)
    # Nothing tells the first action of an episode.
    assert error[first].mean() > 0.3
    assert error[~first].mean() < 0.1
    assert relative_error(policy, others) < 0.5


def test_acting_step_by_step_equals_acting_on_whole_episodes(hidden: Arrays) -> None:
    """The policy remembers its own actions: here they are those of the data that it is then given."""
    policy = trained(hidden.select(np.arange(20)), 2)
    data = hidden.select(np.array([0, 1, 2]))
    rngs = [np.random.default_rng(0) for _ in range(3)]
    acted = np.array([policy.act_together(data.observations[step::12], rngs) for step in range(12)])
    own = replace(data, actions=np.moveaxis(acted, 0, 1).reshape(len(data), -1))
    np.testing.assert_allclose(policy.actions_of(own), own.actions, atol=1e-5)
    # Other episodes begin without a memory, and in other lanes.
    again = policy.act_together(data.observations[[24, 0]], [np.random.default_rng(0) for _ in range(2)])
    np.testing.assert_allclose(again, acted[0][[2, 0]], atol=1e-5)
