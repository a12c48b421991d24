"""No reader follows a dataset to other files of the reader's machine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import imujoco_minari
from imujoco_minari.errors import DatasetError
from imujoco_minari.exporting import export
from imujoco_minari.pictures.rendering.motion import replay
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.storage import file_format
from imujoco_minari.storage.metadata import complete_metadata

ID, NEW = "imujoco/hopper-base-random-v0", "imujoco/hopper-new-v0"


def external(file: h5py.File, secret: Path) -> None:
    rows = len(file["episode_0/rewards"])
    secret.with_suffix(".raw").write_bytes(np.arange(float(rows)).tobytes())
    del file["episode_0/rewards"]
    outside = [(str(secret.with_suffix(".raw")), 0, 8 * rows)]
    file["episode_0"].create_dataset("rewards", shape=(rows,), dtype="f8", external=outside)


def virtual(file: h5py.File, secret: Path) -> None:
    rows = len(file["episode_0/rewards"])
    layout = h5py.VirtualLayout(shape=(rows,), dtype="f8")
    layout[:] = h5py.VirtualSource(secret, "episode_0/rewards", shape=(rows,))
    del file["episode_0/rewards"]
    file["episode_0"].create_virtual_dataset("rewards", layout)


def linked_array(file: h5py.File, secret: Path) -> None:
    del file["episode_0/rewards"]
    file["episode_0/rewards"] = h5py.ExternalLink(secret, "episode_0/rewards")


def linked_episode(file: h5py.File, secret: Path) -> None:
    del file["episode_0"]
    file["episode_0"] = h5py.ExternalLink(secret, "episode_0")


READERS: dict[str, Callable[[Path], Any]] = {
    "arrays": lambda place: imujoco_minari.arrays([ID]),
    "export": lambda place: export([ID], "npz", place / "x.npz"),
    "plot and render": lambda place: replay(ID),
    "combine": lambda place: combine_datasets([ID], NEW),
    "combine --link": lambda place: combine_datasets([ID], NEW, link=True),
}


@pytest.mark.parametrize("reader", list(READERS))
@pytest.mark.parametrize("kind", [external, virtual, linked_array, linked_episode])
def test_values_of_other_files_are_refused(
    small_datasets: list[str], root: Path, tmp_path: Path, kind: Any, reader: str
) -> None:
    data = root / ID / "data"
    secret = tmp_path / "secret" / "main_data.hdf5"
    secret.parent.mkdir()
    secret.write_bytes(file_format.main_file(data).read_bytes())
    with h5py.File(file_format.main_file(data), "a") as file:
        kind(file, secret)
    complete_metadata(data, {})
    with pytest.raises(DatasetError, match=r"another file|link to elsewhere|no dataset of the Minari root"):
        READERS[reader](tmp_path)
