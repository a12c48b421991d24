from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("lerobot")

from cpu_torchvision import import_torchvision

import_torchvision()

from lerobot.datasets.lerobot_dataset import LeRobotDataset


def load(truth, **options):
    return LeRobotDataset("imujoco/test", root=truth.export("lerobot"), **options)


def column(dataset, name):
    return np.asarray(dataset.hf_dataset.with_format("numpy")[:][name])


def test_the_dataset_holds_every_frame(truth):
    dataset = load(truth)
    assert dataset.num_frames == sum(truth.lengths)
    assert dataset.num_episodes == len(truth.episodes)
    for name, array in {
        "observation.state": truth.flat("observations").astype(np.float32),
        "action": truth.flat("actions"),
        "next.reward": truth.flat("rewards").astype(np.float32),
        "next.done": truth.flat("terminations") | truth.flat("truncations"),
        "next.truncated": truth.flat("truncations"),
        "episode_index": np.repeat(np.arange(len(truth.episodes)), truth.lengths),
        "frame_index": np.concatenate([np.arange(length) for length in truth.lengths]),
    }.items():
        np.testing.assert_array_equal(column(dataset, name), array, err_msg=name)


def test_an_item_says_its_task(truth):
    dataset = load(truth)
    item = dataset[dataset.num_frames - 1]
    assert item["task"] == truth.episodes[-1]["variant"]
    np.testing.assert_array_equal(
        item["observation.state"].numpy(), truth.flat("observations")[-1].astype(np.float32)
    )


def test_one_episode_can_be_loaded_alone(truth):
    dataset = load(truth, episodes=[1])
    assert dataset.num_frames == truth.lengths[1]
    np.testing.assert_array_equal(column(dataset, "action"), truth.episodes[1]["actions"])


def test_a_history_is_padded_at_the_episodes_start(truth):
    dataset = load(truth, delta_timestamps={"observation.state": [-1 / load(truth).fps, 0.0]})
    start = truth.lengths[0]
    assert dataset[start]["observation.state_is_pad"].tolist() == [True, False]
    np.testing.assert_array_equal(
        dataset[start + 1]["observation.state"].numpy(),
        truth.episodes[1]["observations"][:2].astype(np.float32),
    )


def test_the_statistics_are_of_the_frames(truth):
    stats = load(truth).meta.stats["observation.state"]
    observations = truth.flat("observations")
    np.testing.assert_allclose(stats["mean"], observations.mean(axis=0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(stats["std"], observations.std(axis=0), rtol=1e-4, atol=1e-6)
    assert stats["count"] == sum(truth.lengths)
