"""What the quick collector records is what the stock one records, array for array."""

from __future__ import annotations

import gc
import shutil
import warnings
from contextlib import contextmanager

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
from actor_datasets import random_weights
from minari.dataset.minari_storage import MinariStorage

from imujoco_minari.envs.registration import environment_spec, make
from imujoco_minari.policies import Actor, RandomPolicy
from imujoco_minari.policies.rollouts import episode_seed, roll_out
from imujoco_minari.publishing.collector import Collector, collect
from imujoco_minari.storage import file_format
from imujoco_minari.storage.writer import EpisodeWriter
from imujoco_minari.variants import specification

ROBOTS = ("hopper", "halfcheetah", "walker2d")


@pytest.fixture
def stock_warnings():
    # The stock collector imports jax, which warns of its own deprecations, and leaves its folders to the
    # garbage collector, which warns of them; create_dataset() warns of each word of metadata not given.
    with warnings.catch_warnings():
        for category in (DeprecationWarning, ResourceWarning, UserWarning):
            warnings.simplefilter("ignore", category)
        yield
        gc.collect()


def stored(data):
    """Return the episodes of a storage as attributes and arrays, as h5py reads them."""
    with h5py.File(file_format.main_file(data), "r") as file:
        return {
            name: (dict(file[name].attrs), {key: array[()] for key, array in file_format.arrays(file[name])})
            for name in (f"episode_{number}" for number in range(len(file)))
        }


def assert_same_but_digests(ours, stock):
    assert list(ours) == list(stock)
    for name in stock:
        attributes, arrays = ours[name]
        assert attributes.pop(file_format.DIGEST) == file_format.episode_sha256(
            {key: file_format.array_sha256(array) for key, array in arrays.items()}
        )
        assert attributes == stock[name][0]
        assert {key: type(value) for key, value in attributes.items()} == {
            key: type(value) for key, value in stock[name][0].items()
        }
        assert set(arrays) == set(stock[name][1])
        for key, array in stock[name][1].items():
            assert arrays[key].dtype == array.dtype
            assert arrays[key].shape == array.shape
            assert arrays[key].tobytes() == array.tobytes()


def short(robot, steps=40):
    return gym.wrappers.TimeLimit(make(f"{robot}-base").unwrapped, steps)


@contextmanager
def collector_in(folder, env):
    """Yield a collector that records in the new folder."""
    with EpisodeWriter(folder, env.spec) as writer, Collector(env, writer) as collector:
        yield collector


@pytest.mark.parametrize("robot", ROBOTS)
def test_records_what_the_stock_collector_records(robot, tmp_path, stock_warnings):
    policy = RandomPolicy(specification(robot).action_size)
    with collector_in(tmp_path / "ours", short(robot)) as collector:
        for episode in range(3):
            roll_out(collector, policy, episode_seed(5, episode))

    stock = minari.DataCollector(short(robot))
    for episode in range(3):
        roll_out(stock, policy, episode_seed(5, episode))
    dataset = stock.create_dataset("test/stock-v0")

    assert_same_but_digests(stored(tmp_path / "ours"), stored(dataset.storage.data_path))
    ours, theirs = MinariStorage.read(tmp_path / "ours").metadata, dataset.storage.metadata
    kept = ours.keys() - {"total_episodes", "total_steps"}
    assert {key: ours[key] for key in kept} == {key: theirs[key] for key in kept}


def test_an_unfinished_episode_is_not_stored_and_a_large_seed_is(tmp_path, stock_warnings):
    def record(collector):
        actions = np.random.default_rng(0)
        collector.reset(seed=2**63 + 1)
        for _ in range(40):
            collector.step(actions.uniform(-1, 1, 6).astype(np.float32))

    with collector_in(tmp_path / "ours", short("halfcheetah")) as ours:
        ours.reset(seed=3)
        ours.step(np.zeros(6, np.float32))
        record(ours)
    stock = minari.DataCollector(short("halfcheetah"))
    record(stock)
    dataset = stock.create_dataset("test/stock-v0")
    assert_same_but_digests(stored(tmp_path / "ours"), stored(dataset.storage.data_path))


def test_warns_of_what_lies_outside_its_space_as_the_stock_collector_does(tmp_path, stock_warnings):
    def record(collector):
        collector.reset(seed=0)
        for scale in (0.5, 2.0, 0.5, -3.0):
            collector.step(np.full(6, scale, np.float32))

    def messages(collector):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            record(collector)
        return [str(warning.message) for warning in caught if "space" in str(warning.message)]

    stock = minari.DataCollector(short("halfcheetah", steps=4))
    expected = messages(stock)
    assert len(expected) == 2
    with collector_in(tmp_path / "ours", short("halfcheetah", steps=4)) as ours:
        assert messages(ours) == expected
    stock.close()


def test_episodes_do_not_depend_on_what_was_recorded_before(tmp_path):
    spec, policy = environment_spec("hopper-base"), RandomPolicy(3)
    collect(spec, policy, range(4), 7, tmp_path / "all", lambda seed: {"tier": "random"})
    collect(spec, policy, [2], 7, tmp_path / "one", lambda seed: {"tier": "random"})
    attributes, arrays = stored(tmp_path / "one")["episode_0"]
    same_attributes, same_arrays = stored(tmp_path / "all")["episode_2"]
    assert attributes | {"id": 2} == same_attributes
    assert attributes["tier"] == "random"
    assert all(arrays[key].tobytes() == same_arrays[key].tobytes() for key in same_arrays)


def untrained(observations=11, actions=3, **options):
    weights = random_weights(observations, actions, width=256, seed=1)
    return Actor(weights, **options)


@pytest.mark.parametrize("deterministic", [True, False])
def test_episodes_of_an_actor_do_not_depend_on_what_is_rolled_out_beside_them(tmp_path, deterministic):
    spec, actor = environment_spec("hopper-base"), untrained(deterministic=deterministic)
    collect(spec, actor, range(19), 7, tmp_path / "all")
    everything = stored(tmp_path / "all")
    assert [attributes["id"] for attributes, _ in everything.values()] == list(range(19))
    assert [attributes["seed"] for attributes, _ in everything.values()] == [
        episode_seed(7, episode) for episode in range(19)
    ]
    assert len({attributes["total_steps"] for attributes, _ in everything.values()}) > 3
    for episodes in ([5], [18, 3, 11], range(4, 14)):
        collect(spec, actor, episodes, 7, tmp_path / "some")
        for place, episode in enumerate(episodes):
            _, arrays = stored(tmp_path / "some")[f"episode_{place}"]
            _, same = everything[f"episode_{episode}"]
            assert all(arrays[key].tobytes() == same[key].tobytes() for key in same)
        shutil.rmtree(tmp_path / "some")
