"""The robots' pages: what they hold, what they must not hold, and that Gymnasium's robots agree with them."""

from __future__ import annotations

import ast
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from hopper_page import hopper_page

import imujoco_minari
from imujoco_minari.errors import CatalogueError
from imujoco_minari.training.hyperparameters import SCRATCH, hyperparameters
from imujoco_minari.variants import CATEGORIES, ROBOTS, known_robots, parse_specification, specification

PACKAGE = Path(imujoco_minari.__file__).parent

GOOD = hopper_page(
    "hopper.xml",
    """\
[reward]
control_cost = 1e-3
healthy = 1
[stance]
leg_joint = -34
[training.warm]
max_steps = 7
"""
    + "".join(f'[{category}]\npercents = [-50]\nbodies = ["foot_geom"]\n' for category in CATEGORIES[:4]),
)


def test_a_specification_reads_back_what_it_says() -> None:
    parsed = parse_specification(GOOD, "good.toml")
    assert parsed.environment == "Hopper-v5"
    assert parsed.title == "Hopper"
    assert parsed.sizes == (11, 3)
    assert parsed.reward.healthy == 1.0
    assert parsed.stance == {"leg_joint": -34.0}
    assert parsed.training == {"warm": {"max_steps": 7}}
    assert parsed.healthy_z_range == (0.7, float("inf"))
    assert parsed.categories["mass"].bodies == {"footgeom": ("foot_geom",)}


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("environment", "enviroment", ["unknown key 'enviroment'", "did you mean 'environment'"]),
        ("[mass]\npercents = [-50]", "[mass]\npercents = [-100]", ["[mass]", "above -100"]),
        ("[mass]\npercents = [-50]", "[mass]\npercents = [0]", ["not 0"]),
        ("[mass]\npercents = [-50]", "[mass]\npercent = [-50]", ["[mass] must hold bodies"]),
        ('feet = ["foot_geom"]', "feet = 3", ["feet must be a list"]),
        ("[0.7, inf]", "[0.7]", ["healthy_z_range"]),
        ("[0.7, inf]", "[0.7, nan]", ["two floats, in metres, the lower one first"]),
        ("[0.7, inf]", "[1.7, 0.7]", ["two floats, in metres, the lower one first"]),
        ('feet = ["foot_geom"]', "feet = []", ["feet must have at least one name"]),
        ("action_size = 3", "action_size = 3" + "0" * 400, ["action_size must be a whole number above 0"]),
        ("action_size = 3", "action_size = 3" + "0" * 5000, ["not TOML"]),
        ("feet =", "action_bound = 1" + "0" * 400 + "\nfeet =", ["action_bound must be a number above 0"]),
        ("feet =", "max_episode_steps = 0\nfeet =", ["max_episode_steps must be a whole number"]),
        ("steps_per_second = 125", "steps_per_second = nan", ["steps_per_second must be a number above 0"]),
        ("action_size = 3", "action_size = 3.0", ["action_size must be a whole number above 0"]),
        ("steps_per_second = 125", "steps_per_second = 0", ["steps_per_second must be a number above 0"]),
        ("observation_size = 11\n", "", ["observation_size must be a whole number", "no such key"]),
        ("root_joints =", "listed = 1\nroot_joints =", ["listed must be true or false"]),
        ("observed_positions = 5", "observed_positions = 11", ["observed_positions must be less than"]),
        ('"Hopper-v5"', '"evil:Hopper-v5"', ["'evil:Hopper-v5' is not the id of a MuJoCo environment"]),
        ('"hopper.xml"', '"../hopper.xml"', ["'../hopper.xml' is not the name of an MJCF file"]),
        ("healthy = 1\n", "", ["[reward] must hold control_cost and healthy"]),
        ("leg_joint = -34", 'leg_joint = "bent"', ["[stance] must hold numbers"]),
        ("[training.warm]\nmax_steps", "[training]\nmax_steps", ["[training] must hold one table"]),
        ("[training.warm]", "[training.wram]", ["unknown start 'wram'", "did you mean 'warm'"]),
        ("max_steps = 7", 'max_steps = "7"', ["[training.warm] max_steps must be a number of at least 0"]),
        ("max_steps = 7", "max_steps = nan", ["[training.warm] max_steps must be a number of at least 0"]),
        ("environment =", "environment = =", ["not TOML"]),
        ("[reward]", "[groups]\nlegs = []\n[reward]", ["[groups] legs has no members"]),
        ("[reward]", '[groups]\nLegs = ["x"]\n[reward]', ["'Legs' must consist of"]),
        ("[reward]", '[groups]\nfootgeom = ["foot_geom"]\n[reward]', ["footgeom is the name of a body too"]),
        ("[joint]", '[joint]\nwiden = ["legs"]', ["[joint] widen has 'legs'"]),
        ("[mass]", "[mass]\nwiden = []", ["[mass] must hold bodies"]),
    ],
)
def test_a_wrong_specification_is_named(before: str, after: str, words: list[str]) -> None:
    assert before in GOOD
    with pytest.raises(CatalogueError) as caught:
        parse_specification(GOOD.replace(before, after, 1), "bad.toml")
    assert all(word in str(caught.value) for word in ["bad.toml", *words]), caught.value


def test_the_robots_are_those_with_a_page_the_smallest_first() -> None:
    pages = {path.stem for path in (PACKAGE.parent / "env_specs").glob("*.toml")}
    assert set(known_robots()) == pages
    assert ROBOTS == ("hopper", "halfcheetah", "walker2d") == known_robots()[:3]


@pytest.mark.parametrize("robot", known_robots())
def test_a_page_agrees_with_gymnasium(robot: str) -> None:
    page = specification(robot)
    env = gym.make(page.environment).unwrapped
    assert env.observation_space.shape == (page.observation_size,)
    assert env.action_space.shape == (page.action_size,)
    assert set(env.action_space.high) == {np.float32(page.action_bound)} == set(-env.action_space.low)
    assert env.dt == pytest.approx(1 / page.steps_per_second, rel=1e-12)  # type: ignore[attr-defined]
    if page.reward is not None:
        assert env._ctrl_cost_weight == page.reward.control_cost  # type: ignore[attr-defined]
        assert getattr(env, "_healthy_reward", 0.0) == page.reward.healthy
    assert page.healthy_z_range == getattr(env, "_healthy_z_range", None)
    model = env.model  # type: ignore[attr-defined]
    count = model.body_jntnum[1]
    assert [model.joint(i).name for i in range(count)] == list(page.root_joints)
    assert all(model.joint(name).id >= 0 for name in page.stance)
    # An observation begins with positions, and the velocities follow.
    observation, _ = env.reset(seed=3)
    data, positions = env.data, page.observed_positions  # type: ignore[attr-defined]
    assert np.array_equal(observation[:positions], data.qpos[-positions:])
    assert np.array_equal(observation[positions : positions + model.nv], data.qvel)
    env.close()


def test_a_robots_own_hyperparameters_take_precedence() -> None:
    assert hyperparameters("hopper", SCRATCH).evaluate_every == 10_000
    assert hyperparameters("halfcheetah", SCRATCH).evaluate_every == 20_000
    assert hyperparameters("halfcheetah", SCRATCH).max_steps == 1_000_000


def robot_tables(path: Path) -> list[int]:
    """The lines of a module that begin a dict with robots as keys."""
    return [
        node.lineno
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Dict)
        and any(isinstance(key, ast.Constant) and key.value in known_robots() for key in node.keys)
    ]


def test_no_table_of_robots_stands_outside_the_pages(tmp_path: Path) -> None:
    # The benchmark's published protocols and results are of the robots that they were published for.
    modules = [path for path in PACKAGE.rglob("*.py") if path.parent.name != "benchmark"]
    found = {path: robot_tables(path) for path in modules}
    assert {path: lines for path, lines in found.items() if lines} == {}
    other = tmp_path / "other.py"
    other.write_text('SIZES = {"hopper": (11, 3), "walker2d": (17, 6)}')
    assert robot_tables(other) == [1]
