"""A loaded policy is used as people expect: called, asked to predict, or to act; one way inside."""

from __future__ import annotations

import numpy as np
import pytest
from stable_baselines3.common.monitor import Monitor

import imujoco_minari
from imujoco_minari import load_policy
from imujoco_minari.errors import ArgumentError

OBSERVATIONS = np.random.default_rng(0).normal(size=(5, 11))


def test_three_doors_give_one_action() -> None:
    policy = load_policy("hopper-base")
    for seen in (OBSERVATIONS[0], OBSERVATIONS):
        action, state = policy.predict(seen)  # type: ignore[attr-defined]
        assert state is None
        assert action.shape == (*seen.shape[:-1], 3)
        assert np.array_equal(action, policy(seen))  # type: ignore[operator]
        assert np.array_equal(action, policy.act(seen))  # type: ignore[call-arg]
        assert np.array_equal(action, policy.predict(seen, deterministic=True)[0])  # type: ignore[attr-defined]


def test_a_policy_that_samples_asks_for_rng_by_name() -> None:
    stochastic = load_policy("hopper-base", stochastic=True)
    for ask in (stochastic, stochastic.act, load_policy("hopper-base", tier="random")):
        with pytest.raises(ArgumentError, match=r"rng=np\.random\.default_rng\(0\)"):
            ask(OBSERVATIONS)  # type: ignore[operator, call-arg]
    first, second = (
        load_policy("hopper-base").predict(  # type: ignore[attr-defined]
            OBSERVATIONS, deterministic=False, rng=np.random.default_rng(3)
        )[0]
        for _ in range(2)
    )
    assert np.array_equal(first, second)
    assert np.array_equal(first, stochastic(OBSERVATIONS, np.random.default_rng(3)))  # type: ignore[operator]
    assert np.array_equal(
        stochastic.predict(OBSERVATIONS, deterministic=True)[0],  # type: ignore[attr-defined]
        load_policy("hopper-base")(OBSERVATIONS),  # type: ignore[operator]
    )


def test_predict_samples_from_numpys_global_source_as_in_stable_baselines3() -> None:
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.utils import set_random_seed

    env = Monitor(imujoco_minari.make("hopper-base"))
    for policy in (load_policy("hopper-base", stochastic=True), load_policy("hopper-base", tier="random")):
        returns = []
        for seed in (7, 7, 8):
            set_random_seed(seed)
            env.reset(seed=0)
            returns.append(evaluate_policy(policy, env, 1, deterministic=False)[0])
        assert returns[0] == returns[1] != returns[2]
    env.close()


def test_a_random_policy_acts_for_a_batch_and_has_no_mode() -> None:
    policy = load_policy("hopper-base", tier="random")
    assert policy(OBSERVATIONS, np.random.default_rng(0)).shape == (5, 3)  # type: ignore[operator]
    with pytest.raises(ArgumentError, match="no deterministic action"):
        policy.predict(OBSERVATIONS, deterministic=True)  # type: ignore[attr-defined]


@pytest.mark.parametrize("observation", [np.zeros(12), np.zeros((2, 3)), 1.0])
def test_an_observation_of_another_length_is_named(observation: np.ndarray) -> None:
    policy = load_policy("hopper-base")
    for door in (policy, policy.act, policy.predict):  # type: ignore[attr-defined]
        with pytest.raises(ArgumentError, match=r"valid: \(11,\), or \(batch, 11\)"):
            door(observation)  # type: ignore[operator]
    assert policy([0.0] * 11).shape == (3,)  # type: ignore[operator]
