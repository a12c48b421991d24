"""Data of randomised environments: published with their parameters, replayed, and found when changed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest

import imujoco_minari
from imujoco_minari.errors import DatasetError, DatasetExistsError
from imujoco_minari.policies.rollouts import episode_seed
from imujoco_minari.storage import file_format
from imujoco_minari.storage.metadata import complete_metadata, read_metadata
from imujoco_minari.variants import Ranges, Variant
from imujoco_minari.variants.context import percents

RANGES = Ranges("hopper", {"mass/torsogeom": (-50, 100), "friction/feet": (-50, 50)})
ID = "imujoco/hopper-randomised-random-v0"
EPISODES = 6

pytestmark = pytest.mark.usefixtures("checked_here")


@pytest.fixture
def data(root: Path) -> Path:
    published = imujoco_minari.publish(RANGES, tier="random", episodes=EPISODES, seed=3)
    assert published.dataset_id == ID
    assert published.path == root / ID
    return published.path / "data"


def test_every_episode_states_its_parameters_and_replays(data: Path) -> None:
    assert imujoco_minari.verify(ID) == []
    dataset = minari.load_dataset(ID)
    env = dataset.recover_environment()
    assert env.unwrapped.ranges == RANGES
    stated = list(dataset.storage.get_episode_metadata(range(EPISODES)))
    for number, (episode, attributes) in enumerate(zip(dataset.iterate_episodes(), stated, strict=True)):
        assert attributes["seed"] == episode_seed(3, number)
        variant = RANGES.draw(int(attributes["seed"]))
        assert attributes["variant"] == str(variant)
        assert (attributes["category"], attributes["body"], attributes["source"]) == ("compound", "", ID)
        assert json.loads(attributes["changes"]) == percents(variant)
        # The recovered environment replays the episode: the seed draws its parameters again.
        observation, info = env.reset(seed=int(attributes["seed"]))
        assert info["variant"] == attributes["variant"]
        assert np.array_equal(observation, episode.observations[0])
        for index, action in enumerate(episode.actions):
            observation, reward, *_ = env.step(action)
            assert np.array_equal(observation, episode.observations[index + 1])
            assert reward == episode.rewards[index]
    assert len({attributes["variant"] for attributes in stated}) == EPISODES


def test_the_content_does_not_depend_on_the_jobs(data: Path) -> None:
    digest = read_metadata(data)["content_sha256"]
    again = imujoco_minari.publish(RANGES, tier="random", episodes=EPISODES, seed=3, jobs=2, force=True)
    assert again.content_sha256 == digest


def test_other_ranges_need_another_name(data: Path) -> None:
    same = imujoco_minari.publish(RANGES, tier="random", episodes=EPISODES, seed=3)
    assert not same.created
    slippery = {"friction/feet": (-50, 0)}
    with pytest.raises(DatasetExistsError, match=r"you asked for ranges \{\"friction/feet\": \[-50, 0\]\}"):
        imujoco_minari.publish(Ranges("hopper", slippery), tier="random", episodes=EPISODES, seed=3)
    named = Ranges("hopper", slippery, name="slippery")
    dataset_id = imujoco_minari.publish(named, tier="random", episodes=2).dataset_id
    assert dataset_id == "imujoco/hopper-slippery-random-v0"
    assert imujoco_minari.verify(dataset_id) == []


def test_ranges_have_no_training_run() -> None:
    with pytest.raises(DatasetError, match="a training run on one variant, not on ranges"):
        imujoco_minari.publish(RANGES, tier="medium-replay")


def test_the_data_loads_and_combines_as_other_data(data: Path) -> None:
    base = imujoco_minari.publish("hopper-base", tier="random", episodes=2).dataset_id
    arrays = imujoco_minari.arrays([ID, base])
    assert [Variant.parse(origin.variant) for origin in arrays.table].count(Variant.parse("hopper-base")) == 1
    assert len(arrays.table) == EPISODES + 1
    imujoco_minari.combine_datasets([ID, base], "me/mixed-v0")
    assert imujoco_minari.verify("me/mixed-v0") == []


def _other_variant(file: h5py.File, metadata: dict[str, Any]) -> None:
    variant = Variant.parse("hopper-massinc_1p5_torsogeom-frictiondec_2_feet")
    file["episode_1"].attrs.update(file_format.attributes(variant, "random"))


def _other_changes(file: h5py.File, metadata: dict[str, Any]) -> None:
    file["episode_1"].attrs["changes"] = json.dumps({"mass/torsogeom": 1.0, "friction/feet": 1.0})


def _other_ranges(file: h5py.File, metadata: dict[str, Any]) -> None:
    for attributes in (file.attrs, metadata):
        attributes["ranges"] = json.dumps({"mass/torsogeom": [-50, 101], "friction/feet": [-50, 50]})


def _no_ranges(file: h5py.File, metadata: dict[str, Any]) -> None:
    for attributes in (file.attrs, metadata):
        attributes["ranges"] = json.dumps({"mass/torsogem": [-50, 100]})


def _other_distribution(file: h5py.File, metadata: dict[str, Any]) -> None:
    metadata["distribution"] = "log-uniform"


def _other_environment(file: h5py.File, metadata: dict[str, Any]) -> None:
    metadata["env_spec"] = metadata["env_spec"].replace("-50", "-49")


def _variants_id(file: h5py.File, metadata: dict[str, Any]) -> None:
    metadata["dataset_id"] = "imujoco/hopper-base-random-v0"


@pytest.mark.parametrize(
    ("change", "where", "what"),
    [
        (_other_variant, "episode_1@variant", ", which its seed draws"),
        (_other_changes, "episode_1@changes", "not '{"),
        (_other_ranges, "episode_0@variant", ", which its seed draws"),
        (_no_ranges, "metadata.json/ranges", "no parameter 'mass/torsogem'"),
        (_other_distribution, "episode_0@variant", ", which its seed draws"),
        (_other_environment, "metadata.json/env_spec/kwargs", "environment has"),
        (_variants_id, "metadata.json/dataset_id", "hopper-base-random"),
    ],
)
def test_a_changed_meaning_is_found(
    data: Path, change: Callable[[h5py.File, dict[str, Any]], None], where: str, what: str
) -> None:
    metadata = read_metadata(data)
    with h5py.File(file_format.main_file(data), "r+") as file:
        change(file, metadata)
    complete_metadata(data, metadata)
    findings = imujoco_minari.verify(ID)
    assert any(where in finding.where and what in finding.what for finding in findings), list(
        map(str, findings)
    )
