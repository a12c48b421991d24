"""Robots of the user: a page and an MJCF file that are not of the package."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from hopper_page import hopper_page

import imujoco_minari
from imujoco_minari.envs import collection_spec, environment_spec, randomised_spec
from imujoco_minari.errors import CatalogueError, ImujocoError, VariantError
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.variants import (
    Ranges,
    Variant,
    adopt_page,
    carried_page,
    catalogue,
    forget_page,
    known_robots,
)
from imujoco_minari.verification import verify

PAGE = hopper_page(
    "strong.xml",
    """\
[mass]
percents = [50]
bodies = ["torso_geom"]
[friction]
percents = [-50]
bodies = ["feet"]
[splits.mass-v1]
description = "every change of mass"
held_out = [{ category = ["mass"] }]
""",
)


@pytest.fixture(autouse=True)
def _forget_pages() -> Iterator[None]:
    yield
    forget_page("strong")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the page of ``strong``, a Hopper with a motor of 250 Nm, whose floor is included."""
    folder = tmp_path / "robots"
    folder.mkdir()
    text = imujoco_minari.canonical_mjcf(Variant.parse("hopper-base")).replace('gear="200', 'gear="250', 1)
    start = text.index("<actuator>")
    end = text.index("</actuator>") + len("</actuator>")
    (folder / "strong.toml").write_text(PAGE)
    (folder / "strong.xml").write_text(text[:start] + '<include file="motors.xml"/>' + text[end:])
    (folder / "motors.xml").write_text(f"<mujocoinclude>{text[start:end]}</mujocoinclude>")
    return folder


def test_a_page_and_a_model_make_a_robot(folder: Path) -> None:
    assert imujoco_minari.load_catalogue(folder) == ("strong",)
    assert known_robots()[-1] == "strong"
    assert len(catalogue()) == 154
    assert list(map(str, catalogue("strong"))) == [
        "strong-massinc_50_torsogeom",
        "strong-frictiondec_50_feet",
    ]
    env = gym.make("imujoco/strong-massinc_50_torsogeom-v0").unwrapped
    base = imujoco_minari.make("hopper-base").unwrapped
    assert env.model.actuator_gear[:, 0].tolist() == [250, 200, 200]  # type: ignore[attr-defined]
    ratio = env.model.body_mass[1:] / base.model.body_mass[1:]  # type: ignore[attr-defined]
    assert ratio == pytest.approx([1.5, 1, 1, 1])
    assert imujoco_minari.held_out("strong-mass-v1").train == ("strong-frictiondec_50_feet",)
    collection = gym.make("imujoco/strong-all-v0")
    assert collection.reset(options={"variant": "strong-massinc_50_torsogeom"})[1]["variant"]
    # Loading again is no conflict.
    assert imujoco_minari.load_catalogue(folder / "strong.toml") == ("strong",)


STRANGER = """
import json, pickle, sys
import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from imujoco_minari.variants import known_robots
from imujoco_minari.verification import verify
assert "strong" not in known_robots()
print(list(verify("imujoco/strong-massinc_50_torsogeom-random-v0")))
assert "strong" in known_robots()
"""


def test_a_dataset_works_where_the_page_is_not(folder: Path) -> None:
    imujoco_minari.load_catalogue(folder)
    published = publish("strong-massinc_50_torsogeom", tier="random", episodes=2)
    assert verify(published.dataset_id) == []
    assert published.path is not None
    metadata = json.loads((published.path / "data" / "metadata.json").read_text())
    (folder / "strong.toml").unlink()
    done = subprocess.run([sys.executable, "-c", STRANGER], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    code = "import gymnasium, sys; from gymnasium.envs.registration import EnvSpec\n"
    code += "print(gymnasium.make(EnvSpec.from_json(sys.argv[1])).reset(seed=3)[0].tolist())"
    run = [sys.executable, "-c", code, metadata["env_spec"]]
    done = subprocess.run(run, capture_output=True, text=True, check=True)
    ours = gym.make(EnvSpec.from_json(metadata["env_spec"])).reset(seed=3)[0]
    assert np.array_equal(json.loads(done.stdout), ours)


def test_a_variant_takes_its_page_to_other_processes(folder: Path) -> None:
    imujoco_minari.load_catalogue(folder)
    text = pickle.dumps(Variant.parse("strong-massinc_50_torsogeom")).hex()
    code = f"import pickle; print(pickle.loads(bytes.fromhex({text!r})).mjcf_names)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "('torso_geom',)"


def test_another_page_of_a_robot_is_refused(folder: Path) -> None:
    imujoco_minari.load_catalogue(folder)
    page = carried_page("strong")
    assert page is not None
    adopt_page("strong", dict(page))
    with pytest.raises(CatalogueError, match=r"another page of the robot strong is loaded.*in a new process"):
        adopt_page("strong", {**page, "toml": PAGE + "# changed"})
    with pytest.raises(CatalogueError, match="another page of the robot hopper is loaded"):
        adopt_page("hopper", page)


@pytest.mark.parametrize(
    ("file", "before", "after", "words"),
    [
        ("strong.toml", "feet =", "foot =", ["unknown key 'foot'", "strong.toml"]),
        ("strong.toml", "Hopper-v5", "Crab-v5", ["Crab-v5 is not one of Gymnasium's MuJoCo environments"]),
        ("strong.toml", '"strong.xml"', '"weak.xml"', ["weak.xml is neither beside its page nor"]),
        (
            "strong.toml",
            '["torso_geom"]',
            '["torsogeom"]',
            ["no limb 'torsogeom'", "did you mean 'torso_geom'"],
        ),
        ("strong.toml", '"rooty"]', '"rootyaw"]', ["no joint 'rootyaw'", "rootx, rootz"]),
        ("strong.toml", "= 125", "= 50", ["steps_per_second = 50, but its environment has 125"]),
        ("strong.toml", "[0.7, inf]", "[70.0, inf]", ["not healthy at rest"]),
        (
            "strong.toml",
            '"Hopper-v5"',
            '"HalfCheetah-v5"',
            ["healthy_z_range, which HalfCheetah-v5 does not take"],
        ),
        ("strong.toml", "action_size = 3", "action_size = 4", ["action_size = 4, but its environment has 3"]),
        ("strong.toml", "description", "describe", ["[splits.mass-v1] must hold description, held_out and"]),
        ("strong.toml", "{ category", "{ categories", ["[splits.mass-v1] unknown rule 'categories'"]),
        ("strong.toml", '["mass"]', '["maß"]', ["[splits.mass-v1] no variant follows"]),
        ("strong.toml", '["mass"]', "3", ["[splits.mass-v1] held_out must be a list of rules"]),
        ("strong.toml", '[{ category = ["mass"] }]', "3", ["held_out must be a list of rules"]),
        ("strong.xml", '<include file="motors.xml"/>', "", ["action_size = 3, but its environment has 0"]),
        ("strong.xml", "motors.xml", "../motors.xml", ["'../motors.xml'", "outside its folder"]),
        ("strong.xml", "motors.xml", "/etc/passwd", ["'/etc/passwd'", "outside its folder"]),
        ("strong.xml", "motors.xml", "none.xml", ["none.xml: cannot be read"]),
        (
            "strong.xml",
            "<worldbody>",
            '<asset><mesh file="../a.stl"/></asset><worldbody>',
            ["<mesh> is refused"],
        ),
        ("strong.xml", "<worldbody>", "<world>", ["not XML"]),
        ("motors.xml", "<actuator>", '<include file="motors.xml"/><actuator>', ["which includes itself"]),
        ("strong.toml", 'feet = ["foot_geom"]', 'feet = ["boot_geom"]', ["no geom 'boot_geom'"]),
        ("motors.xml", "<actuator>", "<actuator>" + "<a>" * 2000 + "</a>" * 2000, ["nested too deep"]),
        ("motors.xml", "<actuator>", "<!--" + " " * 2**20 + "--><actuator>", ["more than 1048576 bytes"]),
    ],
)
def test_what_is_wrong_is_named_in_one_line(
    folder: Path, file: str, before: str, after: str, words: list[str]
) -> None:
    text = (folder / file).read_text()
    assert before in text
    (folder / file).write_text(text.replace(before, after, 1))
    with pytest.raises(ImujocoError) as caught:
        imujoco_minari.load_catalogue(folder)
    assert all(word in str(caught.value) for word in words), caught.value
    assert "\n" not in str(caught.value)
    # A page that was refused leaves nothing behind.
    with pytest.raises(VariantError, match="unknown robot"):
        Variant.parse("strong-base")


def test_files_that_include_each_other_many_times_are_refused(folder: Path) -> None:
    motors = folder / "motors.xml"
    (folder / "part0.xml").write_text(motors.read_text())
    for number in range(1, 20):
        twice = f'<include file="part{number - 1}.xml"/>' * 2
        (folder / f"part{number}.xml").write_text(f"<mujoco>{twice}</mujoco>")
    motors.write_text('<mujoco><include file="part19.xml"/></mujoco>')
    with pytest.raises(CatalogueError, match="has more than 100 includes"):
        imujoco_minari.load_catalogue(folder)


@pytest.mark.parametrize("name", ["strong.toml", "motors.xml"])
def test_a_pipe_is_not_read(folder: Path, name: str) -> None:
    (folder / name).unlink()
    os.mkfifo(folder / name)
    with pytest.raises(CatalogueError, match=rf"{name}: cannot be read: it is no file"):
        imujoco_minari.load_catalogue(folder)


def test_a_corrected_page_is_read_anew(folder: Path) -> None:
    page, motors = folder / "strong.toml", folder / "motors.xml"
    page.write_text(PAGE.replace("= 125", "= 50"))
    with pytest.raises(CatalogueError, match="states steps_per_second = 50"):
        imujoco_minari.load_catalogue(folder)
    page.write_text(PAGE.replace("percents = [50]", "percents = [25]"))
    motors.write_text(motors.read_text().replace('gear="250', 'gear="300'))
    imujoco_minari.load_catalogue(folder)
    env = imujoco_minari.make("strong-base").unwrapped
    assert env.model.actuator_gear[:, 0].tolist() == [300, 200, 200]  # type: ignore[attr-defined]
    assert 'gear="300' in env.mjcf  # type: ignore[attr-defined]
    assert str(catalogue("strong")[0]) == "strong-massinc_25_torsogeom"
    assert imujoco_minari.held_out("strong-mass-v1").test == ("strong-massinc_25_torsogeom",)


def test_an_environment_with_a_wrong_page_leaves_nothing_behind(folder: Path) -> None:
    imujoco_minari.load_catalogue(folder)
    specs = (
        environment_spec("strong-base"),
        collection_spec("strong-mine", ["strong-base"]),
        randomised_spec(Ranges("strong", {"mass/torsogeom": (-50, 50)})),
    )
    forget_page("strong")
    for spec in specs:
        spec.kwargs["page"]["toml"] = PAGE.replace("= 125", "= 50")
        with pytest.raises(CatalogueError, match="states steps_per_second = 50"):
            gym.make(spec)
        assert "strong" not in known_robots()


def test_an_interrupted_loading_leaves_nothing_behind(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(robot: str) -> None:
        assert robot in known_robots()
        raise KeyboardInterrupt

    monkeypatch.setattr("imujoco_minari.envs.mjcf.check_robot", interrupt)
    with pytest.raises(KeyboardInterrupt):
        imujoco_minari.load_catalogue(folder)
    assert "strong" not in known_robots()


def test_a_folder_without_pages_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CatalogueError, match="no page of a robot is here"):
        imujoco_minari.load_catalogue(tmp_path)
    with pytest.raises(CatalogueError, match="cannot be read"):
        imujoco_minari.load_catalogue(tmp_path / "none.toml")
