"""Randomised environments: the drawn model, by independent arithmetic, and an ordinary Gymnasium citizen."""

from __future__ import annotations

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import imujoco_minari
from imujoco_minari.envs.mjcf import canonical_mjcf, compile_mjcf, variant_model
from imujoco_minari.errors import DrawingError, VariantError
from imujoco_minari.variants import Ranges, Variant, bases, catalogue
from imujoco_minari.variants.context import context

RANGES = {"mass/torsogeom": (-50, 100), "length/leggeom": (-25, 50), "friction/feet": (-50, 50)}
NAME = "imujoco/hopper-randomised-v0"


def binary(model: mujoco.MjModel) -> bytes:
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def test_a_model_equals_that_of_its_text_in_every_byte() -> None:
    drawn = [
        Ranges(robot, ranges).draw(seed)
        for seed in range(5)
        for robot, ranges in (
            ("hopper", RANGES | {"mass/leggeom": (-50, 50), "length/thighgeom": (-25, 25)}),
            ("halfcheetah", {"mass/bfoot": (-50, 200), "joint/bthigh": (-50, 0), "length/fthigh": (-25, 50)}),
            ("walker2d", {"length/torsogeom": (-25, 50), "friction/feet": (-50, 50)}),
        )
    ]
    others = [variant for robot in ("ant", "humanoid", "swimmer") for variant in catalogue(robot)]
    for variant in (*bases(), *catalogue(), *others, *drawn):
        assert binary(variant_model(variant)) == binary(compile_mjcf(canonical_mjcf(variant))), variant


def test_every_drawn_parameter_changes_its_quantity_and_no_other() -> None:
    env = imujoco_minari.randomised(
        "hopper", RANGES | {"mass/leggeom": (-50, 50), "joint/legjoint": (-50, 0)}
    )
    base = variant_model(Variant.parse("hopper-base"))
    names = env.unwrapped.parameters
    for seed in range(5):
        _, info = env.reset(seed=seed)
        factor = dict(zip(names, 1 + info["context"], strict=True))
        model = env.unwrapped._current.model
        radius, half = base.geom("leg_geom").size[:2]
        stretched = half * factor["length/leggeom"]
        # A capsule is a cylinder and a sphere.
        volumes = [2 * np.pi * radius**2 * h + 4 / 3 * np.pi * radius**3 for h in (stretched, half)]
        mass = {
            "torso": factor["mass/torsogeom"],
            "leg": factor["mass/leggeom"] * volumes[0] / volumes[1],
            "thigh": 1.0,
            "foot": 1.0,
        }
        for body, wanted in mass.items():
            assert model.body(body).mass[0] == pytest.approx(base.body(body).mass[0] * wanted, rel=1e-9)
        assert model.geom("leg_geom").size[1] == pytest.approx(stretched, rel=1e-12)
        assert model.joint("leg_joint").range == pytest.approx(
            base.joint("leg_joint").range * factor["joint/legjoint"]
        )
        assert model.joint("foot_joint").range == pytest.approx(base.joint("foot_joint").range)
        friction = max(base.geom("foot_geom").friction[0], base.geom("floor").friction[0])
        assert model.pair_friction[0][0] == pytest.approx(friction * factor["friction/feet"], rel=1e-12)
        for geom in ("torso_geom", "thigh_geom", "foot_geom"):
            assert np.array_equal(model.geom(geom).size, base.geom(geom).size)


def test_an_episode_equals_one_of_the_drawn_variants_own_environment() -> None:
    env = imujoco_minari.randomised("hopper", RANGES, "log-uniform")
    actions = np.random.default_rng(0)
    names = set()
    for seed in range(4):
        observation, info = env.reset(seed=seed)
        names.add(info["variant"])
        own = imujoco_minari.make(info["variant"])
        assert np.array_equal(observation, own.reset(seed=seed)[0])
        expected = context(Variant.parse(info["variant"]), tuple(RANGES))
        for _ in range(10):
            action = actions.uniform(-1, 1, 3).astype(np.float32)
            mine, theirs = env.step(action), own.step(action)
            assert np.array_equal(mine[0], theirs[0])
            assert mine[1:4] == theirs[1:4]
            assert mine[4]["variant"] == info["variant"]
            assert np.array_equal(mine[4]["context"], expected)
        assert env.unwrapped.variant == own.unwrapped.variant
    assert len(names) == 4


def test_unseeded_resets_go_on_drawing() -> None:
    env = imujoco_minari.randomised("hopper", RANGES)
    env.reset(seed=1)
    first = [env.reset()[1]["variant"] for _ in range(3)]
    env.reset(seed=1)
    assert [env.reset()[1]["variant"] for _ in range(3)] == first
    assert len(set(first)) == 3


def test_a_variant_can_be_chosen_outside_the_ranges_too() -> None:
    env = imujoco_minari.randomised("hopper", RANGES)
    _, info = env.reset(seed=0, options={"variant": "hopper-massinc_200_torsogeom"})
    assert info["context"].tolist() == [2.0, 0.0, 0.0]
    for name, message in (
        ("hopper-massinc_200_leggeom", "changes mass/leggeom, which is not a parameter of this context"),
        ("walker2d-base", "walker2d-base is not a variant of hopper"),
    ):
        with pytest.raises(VariantError, match=message):
            env.reset(options={"variant": name})


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(DrawingError, match="no ranges are given"):
        gym.make(NAME, ranges={})
    with pytest.raises(
        VariantError, match="changes length/leggeom, which is not a parameter of this context"
    ):
        imujoco_minari.randomised("hopper", RANGES, parameters=["mass/torsogeom"])
