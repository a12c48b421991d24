"""evaluate: every kind of policy, the same seeds for all, and what each episode scored."""

from __future__ import annotations

from functools import reduce
from operator import add
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from random_actors import random_actor
from threadpoolctl import threadpool_info, threadpool_limits

import imujoco_minari
from imujoco_minari import evaluate, make, publish
from imujoco_minari.errors import ArgumentError, ImujocoError, PolicyError, PolicyNotFoundError, VariantError
from imujoco_minari.loading import arrays
from imujoco_minari.policies import RandomPolicy, load_policy, universal_policy
from imujoco_minari.policies.rollouts import episode_seed
from imujoco_minari.policies.sb3 import export_zip
from imujoco_minari.variants import Variant

VARIANT = "hopper-massdec_25_leggeom"


def still(observation: Any) -> Any:
    assert observation.shape == (11,)
    return np.zeros(3)


def outcome(env: Any, policy: Any, **options: Any) -> tuple[list[float], list[int]]:
    result = evaluate(env, policy, **options)
    return result.returns.tolist(), result.lengths.tolist()


def by_hand(env: gym.Env[Any, Any], episodes: int, seed: int) -> tuple[list[float], list[int]]:
    """The returns and lengths of standing still, by Gymnasium's own loop."""
    returns, lengths = [], []
    for number in range(episodes):
        env.reset(seed=episode_seed(seed, number))
        rewards, ended = [], False
        while not ended:
            _, reward, terminated, truncated, _ = env.step(np.zeros(3))
            rewards.append(float(reward))
            ended = terminated or truncated
        # Not the builtin sum, which rounds otherwise since Python 3.12.
        returns.append(reduce(add, rewards))
        lengths.append(len(rewards))
    return returns, lengths


def test_it_scores_what_gymnasiums_own_loop_scores() -> None:
    expected = by_hand(make(VARIANT), 18, seed=3)
    assert len(set(expected[1])) > 3
    assert outcome(VARIANT, still, episodes=18, seed=3) == expected
    assert outcome(Variant.parse(VARIANT), still, episodes=18, seed=3) == expected
    assert outcome(f"imujoco/{VARIANT}-v0", still, episodes=18, seed=3) == expected
    assert outcome(make(VARIANT), still, episodes=18, seed=3) == expected
    assert outcome("Hopper-v5", still, episodes=2) == by_hand(gym.make("Hopper-v5"), 2, seed=0)


def test_an_episode_scores_what_it_scores_in_a_published_dataset() -> None:
    for tier in ("random", "expert"):
        episodes = 18 if tier == "random" else 2
        publish(VARIANT, tier=tier, episodes=episodes, seed=5)
        stored = arrays(Variant.parse(VARIANT).dataset_id(tier))
        result = evaluate(VARIANT, load_policy(VARIANT, tier=tier), episodes=episodes, seed=5)
        assert result.lengths.tolist() == stored.episode_lengths.tolist()
        np.testing.assert_allclose(result.returns, stored.returns, rtol=1e-12)


def linear() -> tuple[np.ndarray[Any, Any], torch.nn.Module]:
    """A linear policy as a matrix and as a torch module that drops half its inputs while it is trained."""
    module = torch.nn.Sequential(torch.nn.Dropout(0.5), torch.nn.Linear(11, 3, bias=False).double())
    return module[1].weight.detach().numpy(), module


def test_the_same_policy_in_every_shape_scores_the_same() -> None:
    weight, module = linear()

    class Mine:
        def act(self, observation: Any, rng: np.random.Generator) -> Any:
            return weight @ observation

    model = SimpleNamespace(predict=lambda observations: observations @ weight.T)
    agent = SimpleNamespace(predict=lambda x, state=None, deterministic=False: (x @ weight.T, None))
    expected = evaluate(VARIANT, lambda observation: weight @ observation, episodes=20)
    for policy in (Mine(), model, agent, module):
        result = evaluate(VARIANT, policy, episodes=20)
        np.testing.assert_allclose(result.returns, expected.returns, rtol=1e-6)
    # It was in training mode before, and is in it again.
    assert all(part.training for part in module.modules())


def test_episodes_run_on_one_thread_of_blas() -> None:
    """On busy cores, several threads take up to 100 times as long."""

    def threads() -> set[int]:
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    seen: list[set[int]] = []

    def policy(observation: Any) -> Any:
        seen.append(threads())
        return np.zeros(3, np.float32)

    with threadpool_limits(2, user_api="blas"):
        before = threads()
        evaluate("hopper-base", policy, episodes=2)
        assert threads() == before != {1}
    assert seen[-1] == {1}


def test_a_model_of_stable_baselines_acts_deterministically(tmp_path: Path) -> None:
    from stable_baselines3 import SAC

    actor = random_actor()
    model = SAC.load(export_zip(Variant.parse("hopper-base"), tmp_path / "sac.zip", actor), device="cpu")
    expected = evaluate("hopper-base", actor, episodes=3)
    for policy in (model, model.policy):
        result = evaluate("hopper-base", policy, episodes=3)
        assert result.lengths.tolist() == expected.lengths.tolist()
        np.testing.assert_allclose(result.returns, expected.returns, rtol=1e-3)


def test_scores_are_normalised_by_the_variant_of_each_episode() -> None:
    result = evaluate("imujoco/hopper-friction-v0", still, episodes=12)
    assert len(set(result.variants)) == 3
    for name, value, score in zip(result.variants, result.returns, result.scores, strict=True):
        record = imujoco_minari.policies.expert_record(Variant.parse(name))
        low, high = record["random"]["return_mean"], record["evaluation"]["return_mean"]
        assert score == pytest.approx((value - low) / (high - low), rel=1e-12)
    assert result.score_mean == pytest.approx(result.scores.mean())
    assert result.score_interval[0] <= result.score_iqm <= result.score_interval[1]


def test_the_summary_is_that_of_the_episodes() -> None:
    seen: list[int] = []
    result = evaluate("hopper-base", RandomPolicy(3), episodes=9, seed=2, on_episode=lambda: seen.append(1))
    assert len(seen) == result.episodes == 9
    assert result.asdict() == {
        "episodes": 9,
        "seed": 2,
        "deterministic": False,
        "return_mean": result.returns.mean(),
        "return_std": result.returns.std(),
        "return_min": result.returns.min(),
        "return_max": result.returns.max(),
        "length_mean": result.lengths.mean(),
    }
    assert result.return_iqm == pytest.approx(np.sort(result.returns)[2:-2].mean())
    assert "9 episodes on hopper-base: return" in repr(result)
    assert "\n" not in repr(result)
    assert evaluate("hopper-base", still, episodes=1).deterministic is None


def test_what_has_no_references_says_so() -> None:
    with pytest.raises(VariantError, match="no variant"):
        _ = evaluate("Hopper-v5", still, episodes=1).scores
    with pytest.raises(PolicyNotFoundError, match="humanoid-base has no expert"):
        _ = evaluate("humanoid-base", lambda observation: np.zeros(17), episodes=1).scores


class Untouched(gym.Wrapper[Any, Any, Any, Any]):
    """An environment that must not be stepped."""

    def step(self, action: Any) -> Any:
        raise AssertionError("it was stepped")


def recurrent(x: Any, state: Any = None, deterministic: bool = False) -> Any:
    return np.zeros((len(x), 3)), ()


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (None, "not NoneType"),
        ("model.zip", r"not str; load a file with load_policy\(variant, path=...\)"),
        (universal_policy("hopper"), r"not UniversalPolicy; for one variant, take policy.fold\(variant\)"),
        (RandomPolicy, "RandomPolicy is a class"),
        (RandomPolicy(6), r"actions of shape \(1, 6\) for 1 observations; valid: \(1, 3\)"),
        (random_actor(17, 6), r"fails on .* shape \(11,\): ArgumentError: .* valid: \(17,\)"),
        (lambda observation: 0.0, r"actions of shape \(1,\)"),
        (lambda observation: np.full(3, np.nan), "not finite numbers"),
        (lambda observation: ["a", "b", "c"], "not finite numbers"),
        (lambda: np.zeros(3), r"fails on observations of shape \(11,\): TypeError: .* takes 0 positional"),
        (torch.nn.Linear(17, 6), r"fails on observations of shape \(11,\): RuntimeError"),
        (torch.nn.LSTM(11, 3), "returns a tuple, not a tensor of actions"),
        (SimpleNamespace(predict=recurrent), "the policy is recurrent"),
    ],
)
def test_a_wrong_policy_fails_before_the_first_step(policy: Any, message: str) -> None:
    with pytest.raises(PolicyError, match=message) as error:
        evaluate(Untouched(make("hopper-base")), policy)
    assert "\n" not in str(error.value)


def test_a_policy_that_fails_later_shows_where() -> None:
    calls: list[int] = []

    def breaks(observation: Any) -> Any:
        calls.append(1)
        return np.zeros(3) if len(calls) < 5 else calls[9]

    with pytest.raises(IndexError):
        evaluate(make("hopper-base"), breaks)
    calls.clear()
    with pytest.raises(PolicyError, match="not finite"):
        evaluate(make("hopper-base"), lambda o: np.full(3, np.nan if o[0] < 1.2 else 0.0))


@pytest.mark.parametrize(
    ("env", "options", "message"),
    [
        (still, {}, "the environment is a variant, its id or a gymnasium.Env, not function; the policy is"),
        (None, {}, "not NoneType"),
        ("hoper-base", {}, "did you mean 'hopper'"),
        ("hopper-base", {"episodes": 0}, "episodes must be a whole number of at least 1, not 0"),
        ("hopper-base", {"episodes": "5"}, "episodes must be a whole number of at least 1, not '5'"),
        ("hopper-base", {"seed": -1}, "seed must be a whole number of at least 0, not -1"),
    ],
)
def test_a_wrong_argument_is_named(env: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ImujocoError, match=message) as error:
        evaluate(env, still, **options)
    assert isinstance(error.value, ArgumentError | VariantError)
