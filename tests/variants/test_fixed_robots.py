"""Robots that are fixed to the ground: arms and pendulums, whose pages name no root joint."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import minari
import numpy as np
import pytest
from PIL import Image

import imujoco_minari
from imujoco_minari.envs.differences import differences
from imujoco_minari.errors import CatalogueError, CatalogueWarning
from imujoco_minari.pictures.gallery.clips import write_portrait
from imujoco_minari.pictures.rendering.scene import scene_model
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.training.sweep import train
from imujoco_minari.training.task import Plan
from imujoco_minari.variants import Variant, catalogue, forget_page
from imujoco_minari.verification import verify

TABLE = """
root_joints = []
[mass]
percents = [50]
bodies = [{bodies}]
[length]
percents = [25]
bodies = [{limbs}]
"""
# name -> environment, model, observation, positions, action, bound, steps a second, bodies, limbs, limit.
ROBOTS = {
    "reacher": ("Reacher-v5", "reacher.xml", 10, 4, 2, 1, 50, "link0", "link1", 50),
    "pusher": ("Pusher-v5", "pusher_v5.xml", 23, 7, 7, 2, 20, "ua", "fa", 100),
    "pendulum": (
        *("InvertedDoublePendulum-v5", "inverted_double_pendulum.xml"),
        *(9, 3, 1, 1, 20, "cpole", "cpole2", 1000),
    ),
    "arm": ("Reacher-v5", "arm.xml", 10, 4, 2, 1, 50, "upper", "lower", 50),
}
ARM = """
<mujoco>
  <option timestep="0.01"/>
  <default><joint armature="1" damping="1"/><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1" pos="0 0 -0.1"/>
    <body name="body0" pos="0 0 0.01">
      <joint name="joint0" type="hinge" axis="0 0 1"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0.12 0 0" size="0.01"/>
      <body name="body1" pos="0.12 0 0">
        <joint name="joint1" type="hinge" axis="0 0 1" range="-3 3" limited="true"/>
        <geom name="lower" type="capsule" fromto="0 0 0 0.08 0 0" size="0.01"/>
        <body name="fingertip" pos="0.09 0 0"><geom name="tip" type="sphere" size="0.01"/></body>
      </body>
    </body>
    <body name="target" pos="0.1 -0.1 0.01">
      <joint name="target_x" type="slide" axis="1 0 0" ref="0.1"/>
      <joint name="target_y" type="slide" axis="0 1 0" ref="-0.1"/>
      <geom name="target" type="sphere" size="0.009"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="joint0" gear="200" ctrlrange="-1 1" ctrllimited="true"/>
    <motor joint="joint1" gear="200" ctrlrange="-1 1" ctrllimited="true"/>
  </actuator>
</mujoco>
"""


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "robots"
    folder.mkdir()
    for robot, (environment, model, *sizes, bodies, limbs, _limit) in ROBOTS.items():
        keys = ("observation_size", "observed_positions", "action_size", "action_bound", "steps_per_second")
        lines = [f'environment = "{environment}"', f'model = "{model}"']
        lines += [f"{key} = {value}" for key, value in zip(keys, sizes, strict=True)]
        table = TABLE.format(bodies=f'"{bodies}"', limbs=f'"{limbs}"')
        (folder / f"{robot}.toml").write_text("\n".join(lines) + table)
    (folder / "arm.xml").write_text(ARM)
    yield folder
    for robot in (*ROBOTS, "faulty"):
        forget_page(robot)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_fixed_robot_is_listed_published_and_combined(robot: str, folder: Path) -> None:
    imujoco_minari.load_catalogue(folder)
    limit, names = ROBOTS[robot][-1], [f"{robot}-massinc_50_{ROBOTS[robot][-3]}", f"{robot}-base"]
    assert str(catalogue(robot)[0]) == names[0]
    assert scene_model(Variant.parse(names[0]), width=32, height=24).ngeom > 4
    assert any(each.unit == "kg" for each in differences(Variant.parse(names[0])))
    datasets = []
    for name in names:
        outcome = publish(name, tier="random", episodes=2)
        assert verify(outcome.dataset_id) == []
        datasets.append(outcome.dataset_id)
    dataset = minari.load_dataset(datasets[0])
    assert dataset.spec.env_spec is not None
    assert dataset.spec.env_spec.max_episode_steps == limit
    longest = max(len(episode.actions) for episode in dataset.iterate_episodes())
    assert longest == limit if robot != "pendulum" else longest < limit
    combined = imujoco_minari.combine_datasets(datasets, f"imujoco/{robot}-both-v0")
    assert combined.total_episodes == 4
    assert verify(f"imujoco/{robot}-both-v0") == []


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_fixed_robot_is_trained(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("sbx")
    imujoco_minari.load_catalogue(folder)
    changes = {"max_steps": 60, "evaluate_every": 30, "exploration_steps": 20}
    episodes = dict.fromkeys((f"{kind}_episodes" for kind in ("choosing", "deciding", "confirming")), 1)
    plan = Plan(tmp_path / "state", tmp_path / "policies", changes=changes | episodes)  # type: ignore[arg-type]
    assert train(Variant("arm"), plan).created


def test_a_robot_whose_page_lists_no_lengths_has_a_portrait(folder: Path, tmp_path: Path) -> None:
    page = folder / "arm.toml"
    page.write_text(page.read_text().replace("[length]", "[size]"))
    imujoco_minari.load_catalogue(page)
    pictures = iter([Image.new("RGB", (8, 8))])
    studio = SimpleNamespace(aspect=1.0, shoot=lambda variant, poses, camera: pictures)
    write_portrait(catalogue("arm")[0], studio, tmp_path / "arm.webp")  # type: ignore[arg-type]
    assert (tmp_path / "arm.webp").is_file()


def test_a_longer_limb_moves_what_hangs_on_it_and_nothing_else(folder: Path) -> None:
    imujoco_minari.load_catalogue(folder)
    base, longer = (
        imujoco_minari.make(name).unwrapped.model  # type: ignore[attr-defined]
        for name in ("arm-base", "arm-lengthinc_25_lower")
    )
    assert longer.geom("lower").size[1] == pytest.approx(1.25 * 0.04)
    assert longer.body("fingertip").pos[0] == pytest.approx(0.09 + 0.25 * 0.08)
    for name in ("body0", "body1", "target"):
        np.testing.assert_allclose(longer.body(name).pos, base.body(name).pos)


def test_a_page_may_state_its_own_limit(folder: Path) -> None:
    page = folder / "arm.toml"
    page.write_text("max_episode_steps = 30\n" + page.read_text())
    imujoco_minari.load_catalogue(page)
    assert imujoco_minari.make("arm-base").spec.max_episode_steps == 30  # type: ignore[union-attr]
    env = imujoco_minari.randomised("arm", {"mass/upper": (-10, 10)})
    assert env.spec is not None
    assert env.spec.max_episode_steps == 30


def test_a_page_with_a_fault_leaves_the_other_robots_alone(folder: Path) -> None:
    (folder / "faulty.toml").write_text((folder / "arm.toml").read_text().replace("[]", "3"))
    with pytest.warns(CatalogueWarning, match="faulty is left out: .*root_joints must be a list of names"):
        assert imujoco_minari.load_catalogue(folder) == ("arm", "pendulum", "pusher", "reacher")
    imujoco_minari.make("arm-base").close()
    with pytest.raises(CatalogueError, match="root_joints must be a list of names"):
        imujoco_minari.make("faulty-base")
    with pytest.raises(CatalogueError, match="root_joints must be a list of names"):
        imujoco_minari.load_catalogue(folder / "faulty.toml")
    (folder / "faulty.toml").write_text((folder / "arm.toml").read_text())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "faulty" in imujoco_minari.load_catalogue(folder)
    imujoco_minari.make("faulty-base").close()
