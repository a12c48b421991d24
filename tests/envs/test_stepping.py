"""Environments step quicker than Gymnasium's, with the same bits."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from gymnasium.envs.mujoco.walker2d_v5 import Walker2dEnv
from gymnasium.envs.registration import load_env_creator

from imujoco_minari.envs import environment_spec
from imujoco_minari.envs.mjcf import canonical_mjcf, healthy_z_range
from imujoco_minari.envs.robots import HopperVariantEnv
from imujoco_minari.variants import Variant

STOCK = {"hopper": HopperEnv, "halfcheetah": HalfCheetahEnv, "walker2d": Walker2dEnv}
CASES = [
    ("hopper-base", {}),
    ("hopper-lengthinc_50_leggeom", {}),
    ("hopper-massinc_200_footgeom", {"healthy_state_range": (-3.0, 3.0), "ctrl_cost_weight": 0.5}),
    ("halfcheetah-base", {"exclude_current_positions_from_observation": False}),
    ("halfcheetah-frictiondec_50_feet", {"forward_reward_weight": 2.0}),
    ("walker2d-base", {"terminate_when_unhealthy": False}),
    ("walker2d-jointdec_50_footjoint", {}),
]


def stock_environment(name, **kwargs):
    """Gymnasium's own class, but for the model and the healthy height."""
    variant = Variant.parse(name)

    class Stock(STOCK[variant.robot]):
        def _initialize_simulation(self):
            model = mujoco.MjModel.from_xml_string(canonical_mjcf(variant))
            return model, mujoco.MjData(model)

    z_range = healthy_z_range(variant)
    return Stock(**({} if z_range is None else {"healthy_z_range": z_range}) | kwargs)


def bits(step):
    observation, *rest, info = step
    return observation.dtype, observation.tobytes(), *map(repr, rest), {k: repr(v) for k, v in info.items()}


@pytest.mark.parametrize(("name", "kwargs"), CASES, ids=[case[0] for case in CASES])
def test_steps_as_gymnasium_does_to_the_bit(name, kwargs):
    ours = load_env_creator(environment_spec(name).entry_point)(name, **kwargs)
    stock = stock_environment(name, **kwargs)
    actions = np.random.default_rng(0)
    healthy = set()
    for seed in range(4):
        first, same = ours.reset(seed=seed), stock.reset(seed=seed)
        assert first[0].tobytes() == same[0].tobytes()
        assert repr(first[1]) == repr(same[1])
        for _ in range(60):
            action = actions.uniform(-1, 1, stock.action_space.shape).astype(np.float32)
            step = ours.step(action)
            assert bits(step) == bits(stock.step(action))
            healthy.add(getattr(ours, "is_healthy", True))
            assert getattr(ours, "is_healthy", True) is getattr(stock, "is_healthy", True)
    assert False in healthy or name.startswith("halfcheetah")


def test_health_is_lost_as_in_gymnasium_where_numbers_are_not_finite():
    ours, stock = HopperVariantEnv("hopper-base"), stock_environment("hopper-base")
    for value in (np.nan, np.inf, 100.0, 99.0):
        for env in (ours, stock):
            env.reset(seed=0)
            env.data.qvel[3] = value
        assert ours.is_healthy is stock.is_healthy
        assert ours._get_obs().tobytes() == stock._get_obs().tobytes()


def test_an_action_of_another_shape_is_refused():
    env = HopperVariantEnv("hopper-base")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"Expected \(3,\), found \(1,\)"):
        env.step(np.zeros(1))
