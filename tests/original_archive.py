"""A small archive in the layout of the original's: gym's XML, Stable-Baselines3 1.x zips, npz tables."""

from __future__ import annotations

import base64
import io
import json
import pickle
import xml.etree.ElementTree as ET
import zipfile
from importlib import resources
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from imujoco_minari.envs import environment_spec
from imujoco_minari.envs.external_mjcf import canonical_external_mjcf
from imujoco_minari.policies import Policy, RandomPolicy
from imujoco_minari.variants import specification
from imujoco_minari.variants.original import OriginalVariant

ASSETS = {"hopper": "hopper.xml", "halfcheetah": "half_cheetah.xml", "walker2d": "walker2d.xml"}
HIDDEN = 16


def gym_root(robot: str) -> ET.Element:
    """gym's own model of a robot: Gymnasium's, but Hopper and Walker2d in global coordinates."""
    text = (resources.files("gymnasium.envs.mujoco") / "assets" / ASSETS[robot]).read_text("utf-8")
    root = ET.fromstring(text)
    if robot != "halfcheetah":
        root.find("compiler").set("coordinate", "global")  # type: ignore[union-attr]
        for body in root.findall("worldbody/body"):
            _globalise(body, np.zeros(3))
    return root


def _globalise(body: ET.Element, parent: Any) -> None:
    origin = parent + _numbers(body.get("pos"))
    body.set("pos", _text(origin))
    for element in body:
        if element.tag == "body":
            _globalise(element, origin)
        else:
            element.set("pos", _text(origin + _numbers(element.get("pos", "0 0 0"))))


def _numbers(text: str | None) -> Any:
    return np.array([float(word) for word in (text or "").split()])


def _text(numbers: Any) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def gym_xml(variant: str) -> str:
    """The XML of a variant, perturbed as the original's were: by hand, in gym's text."""
    parsed = OriginalVariant.parse(variant)
    root = gym_root(parsed.robot)
    (element,) = (
        element
        for element in root.iter("joint" if parsed.category == "joint" else "geom")
        if (element.get("name") or "").replace("_", "") == parsed.body
    )
    if parsed.category == "mass":
        element.set("density", repr(1000 * parsed.changes[0].factor))
    elif parsed.category == "joint":
        element.set("range", _text(_numbers(element.get("range")) * parsed.changes[0].factor))
    elif parsed.category == "friction":
        element.set("friction", repr(float(element.get("friction", "0.4")) * parsed.changes[0].factor))
    else:
        radius, half = _numbers(element.get("size"))
        element.set("size", _text([radius, half * parsed.changes[0].factor]))
    if parsed.robot == "hopper":
        # As gym's file had it; MuJoCo of the time read 0.13 and stopped.
        foot = next(body for body in root.iter("body") if body.get("name") == "foot")
        assert np.allclose(_numbers(foot.get("pos")), [0.13, 0.0, 0.0])
        foot.set("pos", "0.13/2 0 0.1")
    return ET.tostring(root, encoding="unicode")


def actor_state(robot: str, seed: int = 0) -> dict[str, torch.Tensor]:
    """A state dict as SB3 1.x saves a SAC policy's, with random weights."""
    rng = np.random.default_rng(seed)
    observation, action = specification(robot).sizes

    def layer(name: str, inputs: int, outputs: int) -> dict[str, torch.Tensor]:
        weight = rng.normal(0, 1 / np.sqrt(inputs), (outputs, inputs)).astype(np.float32)
        return {
            f"{name}.weight": torch.from_numpy(weight),
            f"{name}.bias": torch.from_numpy(rng.normal(0, 0.1, outputs).astype(np.float32)),
        }

    state = layer("actor.latent_pi.0", observation, HIDDEN) | layer("actor.latent_pi.2", HIDDEN, HIDDEN)
    state |= layer("actor.mu", HIDDEN, action) | layer("actor.log_std", HIDDEN, action)
    for critic in ("critic", "critic_target"):
        for number in range(2):
            state |= layer(f"{critic}.qf{number}.0", observation + action, HIDDEN)
            state |= layer(f"{critic}.qf{number}.2", HIDDEN, HIDDEN) | layer(
                f"{critic}.qf{number}.4", HIDDEN, 1
            )
    return state


class Bomb:
    """What unpickles into a file at ``path``: nothing may unpickle it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return (Path.touch, (self.path,))


def write_sb3_zip(path: Path, robot: str, bomb: Path | None = None) -> None:
    """A zip as Stable-Baselines3 1.x saved it, with pickles in ``data`` that must never be loaded."""
    pickled = base64.b64encode(pickle.dumps(Bomb(bomb) if bomb else {"a": 1})).decode()
    data = {
        "policy_class": {
            ":type:": "<class 'abc.ABCMeta'>",
            ":serialized:": pickled,
            "__module__": "stable_baselines3.sac.policies",
        },
        "verbose": 1,
        "policy_kwargs": {"use_sde": False},
        "observation_space": {
            ":type:": "<class 'gym.spaces.box.Box'>",
            ":serialized:": pickled,
            "_shape": [specification(robot).observation_size],
        },
        "action_space": {
            ":type:": "<class 'gym.spaces.box.Box'>",
            ":serialized:": pickled,
            "low": str(-np.ones(specification(robot).action_size, np.float32)),
            "high": str(np.ones(specification(robot).action_size, np.float32)),
        },
        "use_sde": False,
        "gamma": 0.99,
    }
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", json.dumps(data))
        for name, value in (
            ("policy.pth", actor_state(robot)),
            ("pytorch_variables.pth", {"log_ent_coef": torch.zeros(1)}),
            ("actor.optimizer.pth", {"state": {}, "param_groups": []}),
        ):
            buffer = io.BytesIO()
            torch.save(value, buffer)
            archive.writestr(name, buffer.getvalue())
        archive.writestr("_stable_baselines3_version", "1.6.2")


def table(
    variant: str,
    episodes: int = 3,
    columns: tuple[str, ...] = ("reward", "done"),
    policy: Policy | None = None,
    seed: int = 0,
) -> Any:
    """Rows as the original's authors recorded them, of steps in the variant's own model."""
    parsed = OriginalVariant.parse(variant)
    mjcf = canonical_external_mjcf(gym_xml(variant), parsed.robot, variant)
    env = gym.make(environment_spec(parsed, mjcf))
    policy = policy or RandomPolicy(specification(parsed.robot).action_size)
    rng, rows = np.random.default_rng(seed), []
    for episode in range(episodes):
        observation, _ = env.reset(seed=seed + episode)
        done = False
        while not done:
            action = policy.act(observation, rng)
            after, reward, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
            row = {"reward": [reward], "next_observation": after, "done": [done], "odd": rng.normal(size=1)}
            row |= {"terminated": [terminated], "truncated": [truncated]}
            rows.append(np.concatenate([observation, action, *(row[column] for column in columns)]))
            observation = after
    env.close()
    return np.array(rows)


def write_archive(
    place: Path, variants: tuple[str, ...], episodes: int = 3, columns: tuple[str, ...] = ("reward", "done")
) -> Path:
    """An unpacked archive of some variants."""
    for part in ("xml", "policies", "dataset"):
        (place / part).mkdir(parents=True, exist_ok=True)
    for variant in variants:
        (place / "xml" / f"{variant}.xml").write_text(gym_xml(variant), "utf-8")
        write_sb3_zip(place / "policies" / f"sac-{variant}.zip", variant.partition("-")[0])
        np.savez_compressed(place / "dataset" / f"sac-{variant}.npz", data=table(variant, episodes, columns))
    return place


def zip_parts(place: Path) -> Path:
    """Turn the three folders of an archive into the three zips that were published."""
    for part in ("xml", "policies", "dataset"):
        with zipfile.ZipFile(place / f"{part}.zip", "w") as archive:
            for path in sorted((place / part).iterdir()):
                archive.write(path, f"{part}/{path.name}")
                path.unlink()
        (place / part).rmdir()
    return place
