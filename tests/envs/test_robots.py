"""Variants as Gymnasium environments: registered, picklable, checked, and healthy where they should be."""

from __future__ import annotations

import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import imujoco_minari
from imujoco_minari.errors import VariantError
from imujoco_minari.variants import ROBOTS, Variant, bases, catalogue

EVERY = (*bases(), *catalogue())


def test_every_catalogue_id_is_registered_with_a_string_and_a_variant() -> None:
    for variant in EVERY:
        spec = gym.spec(f"imujoco/{variant}-v0")
        assert isinstance(spec.entry_point, str)
        assert spec.kwargs == {"variant": str(variant)}
        assert spec.max_episode_steps == 1000
        assert EnvSpec.from_json(spec.to_json()) == spec


def test_an_id_is_made_by_its_module_prefix_in_a_process_that_has_not_imported_us() -> None:
    name = "imujoco_minari:imujoco/hopper-massdec_25_leggeom-v0"
    code = f"import gymnasium; print(gymnasium.make({name!r}).reset(seed=0)[0].shape)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "(11,)"


@pytest.mark.parametrize(
    "name",
    [
        "hopper-massdec_25_leggeom",
        "halfcheetah-lengthinc_50_bthigh",
        "walker2d-frictiondec_50_feet",
        "walker2d-all",
        "hopper-length",
        "walker2d-randomised",
    ],
)
def test_gymnasiums_own_check_is_clean(name: str) -> None:
    env = gym.make(f"imujoco/{name}-v0").unwrapped
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env, skip_render_check=True)
    # Unbounded observations are the stock environments' own.
    assert not [str(w.message) for w in caught if "infinity" not in str(w.message)]


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_pickled_environment_goes_on_as_the_original(robot: str) -> None:
    variant = catalogue(robot, "length")[0]
    env = imujoco_minari.make(variant).unwrapped
    copy = pickle.loads(pickle.dumps(env))
    assert copy.variant == variant
    assert copy.mjcf == env.mjcf
    assert np.array_equal(copy.reset(seed=5)[0], env.reset(seed=5)[0])
    action = np.full(env.action_space.shape, 0.3, dtype=np.float32)
    assert np.array_equal(copy.step(action)[0], env.step(action)[0])


@pytest.mark.parametrize("variant", EVERY, ids=str)
def test_an_episode_begins_healthy(variant: Variant) -> None:
    env = imujoco_minari.make(variant)
    env.reset(seed=3)
    _, reward, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    assert np.isfinite(reward)
    assert not terminated
    assert not truncated
    env.close()


def test_any_variant_of_the_grammar_can_be_made_and_registered() -> None:
    env = imujoco_minari.make("hopper-massinc_37_torsogeom")
    assert env.spec is not None
    assert env.spec.id == "imujoco/hopper-massinc_37_torsogeom-v0"
    name = imujoco_minari.register("hopper-massinc_38_torsogeom")
    assert gym.make(name).unwrapped.variant.percent == 38
    gym.registry.pop(name)


def test_environments_of_one_variant_share_no_model() -> None:
    first, second = (imujoco_minari.make("hopper-base").unwrapped for _ in range(2))
    mass = float(second.model.body_mass[1])
    first.model.body_mass[1] *= 2
    first.model.opt.gravity[:] = 0
    third = imujoco_minari.make("hopper-base").unwrapped
    for untouched in (second, third):
        assert untouched.model.body_mass[1] == mass
        assert untouched.model.opt.gravity[2] == -9.81


def test_a_variant_of_another_robot_is_refused() -> None:
    from imujoco_minari.envs.robots import HopperVariantEnv

    with pytest.raises(VariantError, match="not a variant of Hopper-v5"):
        HopperVariantEnv("walker2d-base")
