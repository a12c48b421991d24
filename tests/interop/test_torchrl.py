from __future__ import annotations

import numpy as np
import pytest

torchrl = pytest.importorskip("torchrl")

from imujoco_minari.exporting.adapters import to_tensordict, to_torchrl
from imujoco_minari.loading import arrays


def expected(truth):
    done = truth.flat("terminations") | truth.flat("truncations")
    return {
        "observation": truth.flat("observations"),
        "action": truth.flat("actions"),
        ("next", "observation"): truth.flat("observations", skip_first=True),
        ("next", "reward"): truth.flat("rewards")[:, None],
        ("next", "terminated"): truth.flat("terminations")[:, None],
        ("next", "truncated"): truth.flat("truncations")[:, None],
        ("next", "done"): done[:, None],
    }


def test_the_tensordict_holds_every_step(truth):
    steps = to_tensordict(arrays(truth.ids))
    for key, array in expected(truth).items():
        np.testing.assert_array_equal(steps[key].numpy(), array, err_msg=str(key))


def test_the_replay_buffer_holds_every_step(truth):
    stored = to_torchrl(arrays(truth.ids))[:]
    for key, array in expected(truth).items():
        np.testing.assert_array_equal(stored[key].numpy(), array, err_msg=str(key))


def test_sampled_slices_stay_within_an_episode(truth):
    from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
    from torchrl.data.replay_buffers import SliceSampler

    steps = to_tensordict(arrays(truth.ids))
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(len(steps)),
        sampler=SliceSampler(slice_len=4, traj_key="episode"),
        batch_size=32,
    )
    buffer.extend(steps)
    slices = buffer.sample().reshape(-1, 4)
    assert (slices["episode"] == slices["episode"][:, :1]).all()
    np.testing.assert_array_equal(slices["next", "observation"][:, :-1], slices["observation"][:, 1:])
