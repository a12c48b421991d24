from __future__ import annotations

import numpy as np
import pytest

d3rlpy = pytest.importorskip("d3rlpy")

from imujoco_minari.exporting.adapters import to_d3rlpy
from imujoco_minari.loading import arrays


def test_every_episode_is_whole(truth):
    dataset = to_d3rlpy(arrays(truth.ids))
    assert len(dataset.episodes) == len(truth.episodes)
    for episode, expected in zip(dataset.episodes, truth.episodes, strict=True):
        np.testing.assert_array_equal(episode.observations, expected["observations"][:-1])
        np.testing.assert_array_equal(episode.actions, expected["actions"])
        np.testing.assert_array_equal(episode.rewards[:, 0], expected["rewards"])
        assert episode.terminated == expected["terminations"][-1]


def test_the_transitions_are_the_steps_but_the_last_of_a_truncated_episode(truth):
    dataset = to_d3rlpy(arrays(truth.ids))
    lost = sum(not episode["terminations"][-1] for episode in truth.episodes)
    assert dataset.transition_count == sum(truth.lengths) - lost
    picker = d3rlpy.dataset.BasicTransitionPicker()
    for episode, expected in zip(dataset.episodes, truth.episodes, strict=True):
        for step in range(0, episode.transition_count - 1, 7):
            transition = picker(episode, step)
            np.testing.assert_array_equal(transition.observation, expected["observations"][step])
            np.testing.assert_array_equal(transition.next_observation, expected["observations"][step + 1])
            assert transition.terminal == 0.0
        final = picker(episode, episode.transition_count - 1)
        assert final.terminal == expected["terminations"][-1]


def test_an_algorithm_learns_from_it(truth, tmp_path):
    dataset = to_d3rlpy(arrays(truth.ids, dtype=np.float32))
    learner = d3rlpy.algos.TD3PlusBCConfig(batch_size=32).create()
    losses = learner.fit(
        dataset,
        n_steps=4,
        n_steps_per_epoch=4,
        show_progress=False,
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
    )
    assert np.isfinite(losses[0][1]["critic_loss"])
