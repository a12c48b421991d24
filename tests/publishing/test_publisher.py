"""A published dataset is a stock Minari dataset, complete, and the same however it was made."""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
from random_actors import random_actor
from safetensors.numpy import save_file

import imujoco_minari
from imujoco_minari.envs.mjcf import canonical_mjcf
from imujoco_minari.errors import (
    ArgumentError,
    DatasetExistsError,
    PolicyError,
    PolicyNotFoundError,
)
from imujoco_minari.policies import RandomPolicy, read_actor
from imujoco_minari.publishing import publisher
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.publishing.publisher import publish, publish_all
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.variants import Variant, catalogue
from imujoco_minari.verification import verify

ID = "imujoco/hopper-massdec_25_leggeom-mine-v0"
KEYS = {
    "variant": "hopper-massdec_25_leggeom",
    "robot": "hopper",
    "category": "mass",
    "body": "leggeom",
    "percent": -25,
    "tier": "mine",
}


@pytest.fixture
def actor(tmp_path: Path) -> Path:
    path = tmp_path / "actor.safetensors"
    save_file(dict(random_actor().weights), path)
    return path


@pytest.fixture
def dataset(root: Path, actor: Path) -> minari.MinariDataset:
    outcome = publish("hopper-massdec_25_leggeom", tier="mine", policy=actor, episodes=6, seed=3)
    assert outcome.created
    assert outcome.path == root / ID
    return minari.load_dataset(ID)


def test_stock_minari_sees_all_of_it(dataset: minari.MinariDataset) -> None:
    listed = minari.list_local_datasets()
    assert list(listed) == [ID]
    assert KEYS.items() <= listed[ID].items()
    assert dataset.total_episodes == len(dataset) == 6
    episodes = list(dataset.iterate_episodes())
    assert dataset.total_steps == sum(len(episode) for episode in episodes)
    assert episodes[0].observations.shape == (len(episodes[0]) + 1, 11)
    assert episodes[0].observations.dtype == np.float64
    assert episodes[0].actions.dtype == np.float32
    assert len(dataset.sample_episodes(3)) == 3
    # Minari prints the keys of the infos.
    assert "infos=dict with the following keys: []" in repr(episodes[0])
    train, test = minari.split_dataset(dataset, [4, 2], seed=0)
    assert (len(train), len(test)) == (4, 2)
    assert dataset.filter_episodes(lambda episode: episode.id < 2).total_episodes == 2


def test_attributes_are_on_the_root_and_on_every_episode(dataset: minari.MinariDataset) -> None:
    with h5py.File(dataset.storage.data_path / "main_data.hdf5") as file:
        assert {key: file.attrs[key] for key in KEYS} == KEYS
        assert file.attrs["mjcf"] == canonical_mjcf(Variant.parse("hopper-massdec_25_leggeom"))
        seeds = set()
        for number in range(6):
            attrs = file[f"episode_{number}"].attrs
            assert {key: attrs[key] for key in KEYS} == KEYS
            assert attrs["rewards_sum"] == pytest.approx(file[f"episode_{number}/rewards"][()].sum())
            seeds.add(int(attrs["seed"]))
    assert len(seeds) == 6


def test_the_metadata_says_how_it_was_made(dataset: minari.MinariDataset) -> None:
    metadata = dataset.storage.metadata
    assert f"mujoco=={importlib.metadata.version('mujoco')}" in metadata["requirements"]
    assert metadata["algorithm_name"] == "SAC"
    assert metadata["policy_deterministic"] is True
    assert metadata["policy_sha256"] == random_actor().sha256
    assert metadata["seed"] == 3
    assert metadata["author"]
    assert metadata["code_permalink"]
    assert "leg_geom changed by -25 %" in metadata["description"]
    # Without an expert there is a lowest reference, measured, and no highest.
    assert 0 < metadata["ref_min_score"] < 100


def test_the_environment_is_recovered_by_a_process_that_knows_nothing_of_us(
    dataset: minari.MinariDataset,
) -> None:
    code = (
        "import minari, sys\n"
        f"env = minari.load_dataset({ID!r}).recover_environment()\n"
        "assert env.unwrapped.variant.body == 'leggeom'\n"
        "print(env.spec.id, env.reset(seed=0)[0].shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "imujoco/hopper-massdec_25_leggeom-v0 (11,)"
    spec = json.loads((dataset.storage.data_path / "metadata.json").read_text())["env_spec"]
    assert json.loads(spec)["kwargs"] == {"variant": "hopper-massdec_25_leggeom"}
    assert dataset.env_spec == gym.spec("imujoco/hopper-massdec_25_leggeom-v0")


def test_the_episodes_are_those_of_the_policy_in_the_environment(dataset: minari.MinariDataset) -> None:
    actor, rng = random_actor(), np.random.default_rng(0)
    env = imujoco_minari.make("hopper-massdec_25_leggeom")
    metadata = list(dataset.storage.get_episode_metadata(range(6)))
    for episode, attrs in zip(dataset, metadata, strict=True):
        observation, _ = env.reset(seed=attrs["seed"])
        for step in range(len(episode)):
            assert np.array_equal(observation, episode.observations[step])
            assert np.array_equal(episode.actions[step], actor.act(observation, rng))
            observation, reward, terminated, truncated, _ = env.step(episode.actions[step])
            assert (reward, terminated, truncated) == (
                episode.rewards[step],
                episode.terminations[step],
                episode.truncations[step],
            )
        assert np.array_equal(observation, episode.observations[-1])


def test_the_content_does_not_depend_on_the_number_of_jobs_nor_on_the_time(
    dataset: minari.MinariDataset, actor: Path
) -> None:
    digest = dataset.storage.metadata["content_sha256"]
    options = {"tier": "mine", "policy": actor, "seed": 3, "force": True}
    for jobs in (1, 2):
        assert publish("hopper-massdec_25_leggeom", episodes=6, jobs=jobs, **options).content_sha256 == digest
    assert publish("hopper-massdec_25_leggeom", episodes=5, **options).content_sha256 != digest
    options["seed"] = 4
    assert publish("hopper-massdec_25_leggeom", episodes=6, **options).content_sha256 != digest


def test_what_is_there_is_left_alone(dataset: minari.MinariDataset, actor: Path) -> None:
    file = dataset.storage.data_path / "main_data.hdf5"
    before = (file.stat().st_ino, file.stat().st_mtime_ns)
    recipe = {"tier": "mine", "policy": actor, "episodes": 6, "seed": 3}
    outcome = publish("hopper-massdec_25_leggeom", **recipe)
    assert not outcome.created
    assert outcome.episodes == 6
    assert (file.stat().st_ino, file.stat().st_mtime_ns) == before


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"episodes": 100}, "it has 6 episodes; you asked for 100 episodes"),
        ({"seed": 0}, "it has seed 3; you asked for seed 0"),
        ({"episodes": 7, "seed": 4}, "it has 6 episodes, seed 3; you asked for 7 episodes, seed 4"),
    ],
)
def test_another_recipe_of_the_same_id_is_an_error_that_names_the_difference(
    dataset: minari.MinariDataset, actor: Path, change: dict[str, Any], told: str
) -> None:
    file = dataset.storage.data_path / "main_data.hdf5"
    before = (file.stat().st_ino, file.stat().st_mtime_ns)
    recipe = {"tier": "mine", "policy": actor, "episodes": 6, "seed": 3} | change
    with pytest.raises(DatasetExistsError, match=told) as raised:
        publish("hopper-massdec_25_leggeom", **recipe)
    assert "--force" in str(raised.value)
    assert "\n" not in str(raised.value)
    assert (file.stat().st_ino, file.stat().st_mtime_ns) == before


def test_a_collection_under_the_id_is_another_dataset(dataset: minari.MinariDataset, actor: Path) -> None:
    combine_datasets([ID], ID, force=True)
    recipe = {"tier": "mine", "policy": actor, "episodes": 6, "seed": 3}
    with pytest.raises(
        DatasetExistsError, match=r"it has no seed, no policy, .*; you asked for seed 3, policy "
    ):
        publish("hopper-massdec_25_leggeom", **recipe)
    assert publish("hopper-massdec_25_leggeom", force=True, **recipe).created


def test_a_policy_may_be_an_object(dataset: minari.MinariDataset, actor: Path) -> None:
    recipe = {"tier": "mine", "episodes": 6, "seed": 3}
    assert not publish("hopper-massdec_25_leggeom", policy=read_actor(actor), **recipe).created
    digest = dataset.storage.metadata["content_sha256"]
    again = publish("hopper-massdec_25_leggeom", policy=read_actor(actor), force=True, jobs=2, **recipe)
    assert again.content_sha256 == digest
    sampling = read_actor(actor, deterministic=False)
    with pytest.raises(
        DatasetExistsError, match="it has deterministic actions; you asked for sampled actions"
    ):
        publish("hopper-massdec_25_leggeom", policy=sampling, **recipe)


def test_a_policy_of_the_user_is_published_if_it_states_what_it_is() -> None:
    class Still:
        algorithm, sha256, deterministic = "still", "0" * 64, True

        def act(self, observation: Any, rng: Any) -> Any:
            return np.zeros(3, np.float32)

    published = publish("hopper-base", tier="still", policy=Still(), episodes=2)
    metadata = minari.load_dataset(published.dataset_id).storage.metadata
    assert (metadata["algorithm_name"], metadata["policy_sha256"]) == ("still", "0" * 64)
    assert verify(published.dataset_id) == []


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (
            lambda observation: np.zeros(3),
            r"which function does not have: give a file .*model\.save",
        ),
        (RandomPolicy, "which RandomPolicy does not have"),
        (RandomPolicy(6), r"actions of shape \(1, 6\)"),
        (random_actor(17, 6), "it fits halfcheetah and walker2d"),
    ],
)
def test_another_object_says_what_to_give(policy: Any, message: str, root: Path) -> None:
    with pytest.raises(PolicyError, match=message):
        publish("hopper-base", tier="mine", policy=policy, episodes=1)
    assert minari.list_local_datasets() == {}


def test_another_policy_of_the_same_id_is_an_error(dataset: minari.MinariDataset, tmp_path: Path) -> None:
    other = tmp_path / "other.safetensors"
    save_file(dict(random_actor(activation="ReLU", widths=(8,)).weights), other)
    (outcome,) = publish_all([Recipe(Variant.parse("hopper-massdec_25_leggeom"), "mine", 6, 3, other)])
    assert "it has policy " in outcome.error
    assert not outcome.created


def test_many_are_published_and_a_failure_among_them_is_told(root: Path, actor: Path) -> None:
    recipes = [Recipe(variant, "random", episodes=2) for variant in catalogue("hopper", "friction")]
    recipes.insert(1, Recipe(Variant.parse("walker2d-base"), "mine", episodes=2, policy=actor))
    outcomes = list(publish_all(recipes))
    assert [bool(outcome.error) for outcome in outcomes] == [False, True, False, False]
    assert "walker2d has 17 and 6" in outcomes[1].error
    assert len(minari.list_local_datasets()) == 3
    assert sorted(path.name for path in root.iterdir()) == ["imujoco"]


def test_a_failure_leaves_nothing_behind(root: Path) -> None:
    with pytest.raises(PolicyNotFoundError, match="train one"):
        publish("humanoid-base")
    assert not list(root.rglob("*.hdf5"))
    assert minari.list_local_datasets() == {}


def test_random_data_spans_the_action_space_and_repeats() -> None:
    outcome = publish("halfcheetah-massdec_25_bfoot", tier="random", episodes=1)
    actions = minari.load_dataset(outcome.dataset_id)[0].actions
    assert actions.shape == (1000, 6)
    assert np.abs(actions.mean(axis=0)).max() < 0.1
    assert minari.load_dataset(outcome.dataset_id).storage.metadata["policy_deterministic"] is False


@pytest.mark.parametrize("fields", [{"episodes": 0}, {"seed": -1}])
def test_a_recipe_that_makes_no_sense_is_refused(fields: dict[str, int]) -> None:
    with pytest.raises(ArgumentError):
        Recipe(Variant.parse("hopper-base"), **fields)


@pytest.mark.parametrize("episodes", [2, 3])
def test_a_publisher_that_another_one_overtakes_says_what_it_finds(
    monkeypatch: pytest.MonkeyPatch, episodes: int
) -> None:
    write = publisher.record_shares

    def overtaken(recipe: Recipe, *args: Any) -> None:
        monkeypatch.setattr(publisher, "record_shares", write)
        publish("hopper-base", tier="random", episodes=episodes)
        write(recipe, *args)

    monkeypatch.setattr(publisher, "record_shares", overtaken)
    if episodes == 2:
        assert not publish("hopper-base", tier="random", episodes=2).created
    else:
        with pytest.raises(DatasetExistsError, match="it has 3 episodes; you asked for 2 episodes"):
            publish("hopper-base", tier="random", episodes=2)
