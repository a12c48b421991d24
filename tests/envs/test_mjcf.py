"""The texts and environments of the 154 models. tests/envs/test_categories.py proves what they change."""

from __future__ import annotations

import gymnasium
import mujoco
import numpy as np
import pytest

from imujoco_minari.envs import mjcf
from imujoco_minari.envs.mjcf import canonical_mjcf
from imujoco_minari.envs.registration import make
from imujoco_minari.variants import CATEGORIES, ROBOTS, Change, Variant, catalogue, specification


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("category", CATEGORIES)
def test_a_change_of_nothing_is_the_stock_environment_step_for_step(robot: str, category: str) -> None:
    ids = {"hopper": "Hopper-v5", "halfcheetah": "HalfCheetah-v5", "walker2d": "Walker2d-v5"}
    for body in specification(robot).categories[category].bodies:
        theirs = gymnasium.make(ids[robot], disable_env_checker=True)
        ours = make(Variant(robot, (Change(category, 0, body),)), disable_env_checker=True)
        rng = np.random.default_rng(1)
        for seed in range(3):
            assert np.array_equal(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0])
            for _ in range(100):
                action = rng.uniform(-1, 1, ours.action_space.shape).astype(np.float32)
                mine, stocks = ours.step(action), theirs.step(action)
                assert np.array_equal(mine[0], stocks[0])
                assert mine[1:4] == stocks[1:4]
                assert mine[4] == stocks[4]
                if mine[2] or mine[3]:
                    break


@pytest.mark.parametrize("variant", catalogue(), ids=str)
def test_the_text_is_stable_and_loads_without_a_warning(
    variant: Variant, capfd: pytest.CaptureFixture[str]
) -> None:
    first = canonical_mjcf(variant)
    for cached in (canonical_mjcf, mjcf._edited, mjcf._base):
        cached.cache_clear()
    assert canonical_mjcf(variant) == first
    model = mujoco.MjModel.from_xml_string(first)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=50)
    assert np.isfinite(data.qpos).all()
    assert capfd.readouterr().err == ""
