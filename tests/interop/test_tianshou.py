from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("tianshou")

from imujoco_minari.exporting.adapters import to_tianshou
from imujoco_minari.loading import arrays


def test_the_buffer_holds_every_step(truth):
    buffer = to_tianshou(arrays(truth.ids))
    assert len(buffer) == sum(truth.lengths)
    np.testing.assert_array_equal(buffer.obs, truth.flat("observations"))
    np.testing.assert_array_equal(buffer.obs_next, truth.flat("observations", skip_first=True))
    np.testing.assert_array_equal(buffer.act, truth.flat("actions"))
    np.testing.assert_array_equal(buffer.rew, truth.flat("rewards"))
    np.testing.assert_array_equal(buffer.terminated, truth.flat("terminations"))
    np.testing.assert_array_equal(buffer.truncated, truth.flat("truncations"))


def test_the_buffer_knows_where_episodes_end(truth):
    buffer = to_tianshou(arrays(truth.ids))
    ends = np.cumsum(truth.lengths) - 1
    rows = np.arange(len(buffer))
    np.testing.assert_array_equal(np.flatnonzero(buffer.next(rows) == rows), ends)
    np.testing.assert_array_equal(np.flatnonzero(buffer.done), ends)


def test_a_sampled_batch_is_of_the_steps_it_names(truth):
    batch, rows = to_tianshou(arrays(truth.ids)).sample(64)
    np.testing.assert_array_equal(batch.obs, truth.flat("observations")[rows])
    np.testing.assert_array_equal(batch.obs_next, truth.flat("observations", skip_first=True)[rows])
