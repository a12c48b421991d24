from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

d4rl = pytest.importorskip("d4rl")

from d4rl.offline_env import OfflineEnv


class Environment(OfflineEnv):
    """An offline environment of D4RL's that has nothing but the sizes with which it checks a dataset."""

    observation_space = action_space = None

    def __init__(self, observation, action):
        self.observation_space = SimpleNamespace(shape=(observation,))
        self.action_space = SimpleNamespace(shape=(action,))


def load(truth):
    environment = Environment(*((11, 3) if truth.robot == "hopper" else (17, 6)))
    return environment.get_dataset(h5path=str(truth.export("d4rl")))


def test_get_dataset_reads_every_array(truth):
    data = load(truth)
    terminations = truth.flat("terminations")
    for name, array in {
        "observations": truth.flat("observations"),
        "actions": truth.flat("actions"),
        "rewards": truth.flat("rewards"),
        "next_observations": truth.flat("observations", skip_first=True),
    }.items():
        assert data[name].dtype == np.float32
        np.testing.assert_array_equal(data[name], array.astype(np.float32), err_msg=name)
    np.testing.assert_array_equal(data["terminals"], terminations)
    np.testing.assert_array_equal(data["timeouts"], truth.flat("truncations") & ~terminations)


def test_qlearning_dataset_makes_no_step_across_episodes(truth):
    data = d4rl.qlearning_dataset(None, dataset=load(truth))
    # It leaves out the steps that timeouts mark, and the very last.
    kept = ~truth.flat("truncations")
    kept[-1] = False
    np.testing.assert_array_equal(data["observations"], truth.flat("observations")[kept].astype(np.float32))
    within = ~truth.flat("terminations")[kept]
    np.testing.assert_array_equal(
        data["next_observations"][within],
        truth.flat("observations", skip_first=True)[kept][within].astype(np.float32),
    )
    np.testing.assert_array_equal(data["terminals"], ~within)


def test_sequence_dataset_finds_the_episodes(truth):
    sequences = list(d4rl.sequence_dataset(None, dataset=load(truth)))
    assert [len(sequence["rewards"]) for sequence in sequences] == truth.lengths
