"""Environments that draw a variant: by seed, by weight, and reported at every step."""

from __future__ import annotations

import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import imujoco_minari
from imujoco_minari.envs import collection_spec
from imujoco_minari.errors import ArgumentError, DrawingError, VariantError
from imujoco_minari.variants import Variant, catalogue
from imujoco_minari.variants.context import context


def test_a_collection_takes_the_variant_asked_for_and_equals_it() -> None:
    env = gym.make("imujoco/hopper-all-v0")
    for name in ("hopper-lengthinc_50_leggeom", "hopper-massdec_25_leggeom"):
        own = imujoco_minari.make(name)
        observation, info = env.reset(seed=9, options={"variant": name})
        assert info["variant"] == name
        assert np.array_equal(observation, own.reset(seed=9)[0])
        action = np.array([0.5, -0.5, 0.1], dtype=np.float32)
        assert np.array_equal(env.step(action)[0], own.step(action)[0])


def test_a_collection_draws_variants_by_seed() -> None:
    env = gym.make("imujoco/walker2d-mass-v0")
    drawn = [env.reset(seed=seed)[1]["variant"] for seed in range(30)]
    assert drawn == [env.reset(seed=seed)[1]["variant"] for seed in range(30)]
    assert len(set(drawn)) > 10
    first, _ = env.reset(seed=1)
    again, _ = env.reset()
    assert not np.array_equal(first, again)


def test_a_collection_refuses_strangers() -> None:
    env = gym.make("imujoco/hopper-mass-v0")
    with pytest.raises(VariantError, match=r"not in this collection.*did you mean"):
        env.reset(options={"variant": "hopper-massdec_25_leggem"})
    from imujoco_minari.envs.drawing import CollectionEnv

    with pytest.raises(VariantError, match="of one robot, not of hopper, walker2d"):
        CollectionEnv(["hopper-base", "walker2d-base"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"varient": "hopper-base"},
            "unknown option of a reset 'varient' .*'variant'.*; valid: variant",
        ),
        ("hopper-base", "are a dict.*not 'hopper-base'"),
    ],
)
def test_a_reset_refuses_options_that_it_does_not_have(options: Any, words: str) -> None:
    env = gym.make("imujoco/hopper-mass-v0")
    with pytest.raises(ArgumentError, match=words):
        env.reset(options=options)


def test_a_collector_of_minari_may_pass_its_options() -> None:
    env = gym.make("imujoco/hopper-mass-v0")
    name = "hopper-massdec_25_leggeom"
    assert env.reset(options={"minari_autoseed": False, "variant": name})[1]["variant"] == name


def test_every_step_reports_the_variant_and_its_context() -> None:
    env = gym.make("imujoco/hopper-all-v0")
    names = env.unwrapped.parameters
    assert len(names) == len({(v.category, v.body) for v in catalogue("hopper")})
    action = np.zeros(3, dtype=np.float32)
    for seed in range(5):
        _, info = env.reset(seed=seed)
        expected = context(Variant.parse(info["variant"]), names)
        drawn, ended = info["variant"], False
        while not ended:
            assert info["variant"] == drawn == str(env.unwrapped.variant)
            assert np.array_equal(info["context"], expected)
            _, _, terminated, truncated, info = env.step(action)
            ended = terminated or truncated


def test_the_observed_context_is_appended_to_the_variants_own_observation() -> None:
    env = gym.make("imujoco/walker2d-joint-v0", observe_context=True)
    assert env.observation_space.shape == (17 + 6,)
    action = np.full(6, 0.2, dtype=np.float32)
    for name in ("walker2d-jointdec_25_legjoint", "walker2d-jointdec_50_footleftjoint"):
        own = imujoco_minari.make(name)
        observation, info = env.reset(seed=4, options={"variant": Variant.parse(name)})
        assert np.array_equal(observation, np.append(own.reset(seed=4)[0], info["context"]))
        observation, _, _, _, info = env.step(action)
        assert np.array_equal(observation, np.append(own.step(action)[0], info["context"]))
        assert env.observation_space.contains(observation)


def test_variants_are_drawn_by_their_weights() -> None:
    rare, common, never = catalogue("hopper", "friction")
    weights = {rare: 0.25, str(never): np.int64(0)}
    env = gym.make("imujoco/hopper-friction-v0", weights=weights)
    drawn = [env.reset(seed=seed)[1]["variant"] for seed in range(500)]
    assert set(drawn) == {str(rare), str(common)}
    # The standard deviation of a share of 0.2 among 500 is 0.018.
    assert drawn.count(str(rare)) / 500 == pytest.approx(0.2, abs=0.08)
    assert drawn == [env.reset(seed=seed)[1]["variant"] for seed in range(500)]


def test_one_layout_serves_training_and_test_variants() -> None:
    train = gym.make("imujoco/hopper-mass-v0", observe_context=True)
    spec = collection_spec("hopper-test", ["hopper-massinc_37_leggeom", "hopper-base"])
    test = gym.make(spec, parameters=train.unwrapped.parameters, observe_context=True)
    assert test.observation_space == train.observation_space
    _, info = test.reset(options={"variant": "hopper-massinc_37_leggeom"})
    assert dict(zip(test.unwrapped.parameters, info["context"], strict=True))["mass/leggeom"] == 0.37


@pytest.mark.parametrize(
    ("name", "options", "size"),
    [
        ("imujoco/hopper-friction-v0", {"weights": {"hopper-frictiondec_25_feet": 9.0}}, 12),
        ("imujoco/hopper-randomised-v0", {"ranges": {"mass/torsogeom": [-50, 100]}}, 12),
    ],
)
def test_a_drawing_environment_survives_pickle_json_and_vectors(
    name: str, options: dict[str, Any], size: int
) -> None:
    env = gym.make(name, **options, observe_context=True)
    assert env.spec.id == name
    assert env.observation_space.shape == (size,)
    stored = EnvSpec.from_json(env.spec.to_json())
    assert stored == env.spec
    others = [gym.make(stored), pickle.loads(pickle.dumps(env.unwrapped))]
    vector = gym.make_vec(name, num_envs=3, vectorization_mode="sync", **options, observe_context=True)
    rows, infos = vector.reset(seed=[1, 2, 3])
    for index, seed in enumerate((1, 2, 3)):
        observation, info = env.reset(seed=seed)
        for other in others:
            again, other_info = other.reset(seed=seed)
            assert np.array_equal(again, observation)
            assert other_info["variant"] == info["variant"]
        assert np.array_equal(rows[index], observation)
        assert infos["variant"][index] == info["variant"]
        assert np.array_equal(infos["context"][index], info["context"])
        assert np.array_equal(observation[-1:], info["context"])
    vector.close()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"weights": {"hopper-frictiondec_50_fee": 1}}, VariantError, "not in this collection"),
        (
            {"weights": {"hopper-frictiondec_50_feet": -1}},
            DrawingError,
            "weight of .* is -1; valid: a number",
        ),
        ({"weights": {"hopper-frictiondec_50_feet": float("nan")}}, DrawingError, "is nan; valid"),
        (
            {"weights": {str(v): 0 for v in catalogue("hopper", "friction")}},
            DrawingError,
            "every variant has",
        ),
        ({"parameters": ["mass/torsogeom"]}, VariantError, "changes friction/feet, which is not a parameter"),
        ({"parameters": ["friction/foot"]}, VariantError, "hopper has no parameter"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        gym.make("imujoco/hopper-friction-v0", **arguments)
