"""What every library's test compares with: the episodes, read from the HDF5 file by plain h5py.

These tests run in the libraries' own environments (scripts/test-interop), where neither Minari nor MuJoCo
need be installed; elsewhere each skips itself.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest

IDS = {
    "hopper": ["imujoco/hopper-base-random-v0", "imujoco/hopper-massdec_25_leggeom-random-v0"],
    "halfcheetah": ["imujoco/halfcheetah-base-random-v0"],
}


@dataclass(frozen=True)
class Truth:
    """The episodes of one robot's datasets, as they are stored, and where their exports lie."""

    robot: str
    ids: list[str]
    folder: Path
    episodes: list[dict[str, np.ndarray]]

    def export(self, format: str, *, states_only: bool = False) -> Path:
        return self.folder / f"{self.robot}-{format}{'-states' if states_only else ''}"

    def flat(self, name: str, *, skip_first: bool = False) -> np.ndarray:
        """One array of all episodes; of observations without the last of each, or without the first."""
        cut = slice(1, None) if skip_first else slice(None, -1) if name == "observations" else slice(None)
        return np.concatenate([episode[name][cut] for episode in self.episodes])

    @property
    def lengths(self) -> list[int]:
        return [len(episode["rewards"]) for episode in self.episodes]


@pytest.fixture(params=["hopper", "halfcheetah"])
def truth(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Truth:
    folder = os.environ.get("IMUJOCO_INTEROP_DATA")
    if folder is None:
        pytest.skip("run by scripts/test-interop, which makes the data")
    monkeypatch.setenv("MINARI_DATASETS_PATH", f"{folder}/root")
    episodes = []
    for dataset_id in IDS[request.param]:
        with h5py.File(f"{folder}/root/{dataset_id}/data/main_data.hdf5", "r") as file:
            for number in range(len(file)):
                group = file[f"episode_{number}"]
                arrays = {name: group[name][()] for name in group if isinstance(group[name], h5py.Dataset)}
                episodes.append(arrays | {"variant": group.attrs["variant"]})
    truth = Truth(request.param, IDS[request.param], Path(folder), episodes)
    ended = [bool(episode["terminations"][-1]) for episode in episodes]
    assert all(ended) if request.param == "hopper" else not any(ended)
    return truth


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail where the library is said to be there and a test was skipped all the same."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if "IMUJOCO_INTEROP_LIBRARY" in os.environ and reporter.stats.get("skipped"):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
