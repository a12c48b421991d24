from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("ding")

from ding.utils.data.dataset import HDF5Dataset
from easydict import EasyDict
from torch.utils.data import DataLoader


def load(path):
    return HDF5Dataset(EasyDict(policy={"collect": {"data_path": str(path)}}))


def test_the_dataset_holds_every_step(truth):
    dataset = load(truth.export("di-engine"))
    assert len(dataset) == sum(truth.lengths)
    batch = next(iter(DataLoader(dataset, batch_size=len(dataset))))
    expected = {
        "obs": truth.flat("observations"),
        "action": truth.flat("actions"),
        "reward": truth.flat("rewards"),
        "done": truth.flat("terminations"),
        "next_obs": truth.flat("observations", skip_first=True),
    }
    assert set(expected) <= set(batch)
    for key, array in expected.items():
        np.testing.assert_array_equal(np.squeeze(batch[key].numpy()), array.astype(np.float32), err_msg=key)
