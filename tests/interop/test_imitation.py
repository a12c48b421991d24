from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("imitation")

from imitation.data import rollout, serialize, types

from imujoco_minari.exporting.adapters import to_imitation
from imujoco_minari.loading import arrays


def test_every_trajectory_is_whole(truth):
    trajectories = to_imitation(arrays(truth.ids))
    assert len(trajectories) == len(truth.episodes)
    for trajectory, expected in zip(trajectories, truth.episodes, strict=True):
        assert isinstance(trajectory, types.TrajectoryWithRew)
        np.testing.assert_array_equal(trajectory.obs, expected["observations"])
        np.testing.assert_array_equal(trajectory.acts, expected["actions"])
        np.testing.assert_array_equal(trajectory.rews, expected["rewards"])
        assert trajectory.terminal == expected["terminations"][-1]


def test_flattened_they_are_the_steps(truth):
    steps = rollout.flatten_trajectories_with_rew(to_imitation(arrays(truth.ids)))
    np.testing.assert_array_equal(steps.obs, truth.flat("observations"))
    np.testing.assert_array_equal(steps.next_obs, truth.flat("observations", skip_first=True))
    np.testing.assert_array_equal(steps.dones, truth.flat("terminations"))
    np.testing.assert_array_equal(steps.rews, truth.flat("rewards"))


def test_they_are_saved_and_loaded_by_imitation(truth, tmp_path):
    serialize.save(tmp_path / "trajectories", to_imitation(arrays(truth.ids)))
    loaded = serialize.load(tmp_path / "trajectories")
    assert len(loaded) == len(truth.episodes)
    np.testing.assert_array_equal(loaded[1].obs, truth.episodes[1]["observations"])
