from __future__ import annotations

import numpy as np
import pytest

tfds = pytest.importorskip("tensorflow_datasets")


def load(path):
    return list(tfds.builder_from_directory(str(path)).as_dataset(split="train"))


def test_every_episode_is_whole(truth):
    episodes = load(truth.export("rlds"))
    assert len(episodes) == len(truth.episodes)
    for episode, expected in zip(episodes, truth.episodes, strict=True):
        steps = next(iter(episode["steps"].batch(2000).as_numpy_iterator()))
        length = len(expected["rewards"])
        np.testing.assert_array_equal(steps["observation"], expected["observations"].astype(np.float32))
        np.testing.assert_array_equal(steps["action"][:length], expected["actions"])
        np.testing.assert_array_equal(steps["reward"][:length], expected["rewards"].astype(np.float32))
        np.testing.assert_array_equal(np.flatnonzero(steps["is_first"]), [0])
        np.testing.assert_array_equal(np.flatnonzero(steps["is_last"]), [length])
        terminal = [length] if expected["terminations"][-1] else []
        np.testing.assert_array_equal(np.flatnonzero(steps["is_terminal"]), terminal)
        np.testing.assert_array_equal(np.flatnonzero(steps["discount"] == 0), terminal)
        assert episode["metadata"]["variant"].numpy().decode() == expected["variant"]
        assert episode["metadata"]["tier"].numpy() == b"random"
        assert int(episode["metadata"]["percent"]) == (-25 if "dec_25" in expected["variant"] else 0)


def test_the_builder_counts_the_episodes(truth):
    builder = tfds.builder_from_directory(str(truth.export("rlds")))
    assert builder.info.splits["train"].num_examples == len(truth.episodes)


def test_the_states_come_without_actions(truth):
    episode = load(truth.export("rlds", states_only=True))[0]
    step = next(iter(episode["steps"]))
    assert "action" not in step
    assert "reward" not in step
    np.testing.assert_array_equal(
        step["observation"], truth.episodes[0]["observations"][0].astype(np.float32)
    )


def test_the_records_have_tensorflows_checksums(truth):
    import tensorflow as tf

    # TensorFlow raises DataLossError where a checksum is wrong.
    files = sorted(map(str, truth.export("rlds").glob("*.tfrecord-*")))
    assert sum(1 for _ in tf.data.TFRecordDataset(files)) == len(truth.episodes)
