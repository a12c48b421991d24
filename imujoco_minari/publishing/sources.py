"""The datasets that go into a collection: loaded without running anything, and checked to make one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
from gymnasium.envs.registration import EnvSpec
from minari import MinariDataset

from imujoco_minari.errors import DatasetError
from imujoco_minari.storage import copying, file_format, minari_root
from imujoco_minari.storage.missing import not_in_root
from imujoco_minari.verification.identity import read_metadata

# What tells of what an episode is; a collection says it itself where all its episodes agree.
IDENTITY = ("variant", "robot", "category", "body", "percent", "tier")


@dataclass(frozen=True)
class Source:
    """One dataset, or view of one, that goes into a collection.

    Attributes:
        dataset_id: its id.
        file: its HDF5 file.
        episodes: the numbers of those that go in.
        storage: Minari's, with the metadata.
        env_spec: of its environment, where it has one.
        content_sha256: the digest that its metadata states, if any.
    """

    dataset_id: str
    file: Path
    episodes: Sequence[int]
    storage: Any
    env_spec: EnvSpec | None
    content_sha256: str | None

    def attributes(self, said: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Return what identifies each episode, given what the file says of itself.

        Raises:
            DatasetError: when the file is not the one that the metadata is of.
        """
        if said.get("content_sha256") != self.content_sha256:
            raise DatasetError(
                f"{self.dataset_id} was replaced while it was read, or is damaged: nothing was combined"
            )
        if all(key in said for key in IDENTITY):
            return [{key: said[key] for key in IDENTITY}] * len(self.episodes)
        with h5py.File(self.file, "r") as file:
            return copying.episode_attributes(file, self.episodes, IDENTITY)


def open_source(dataset: MinariDataset | str) -> Source:
    """Return a dataset, or the one that has an id, as a source.

    Raises:
        DatasetNotFoundError: when the id names no dataset of the Minari root.
        DatasetError: when it cannot be loaded, or not without risk.
    """
    if isinstance(dataset, str):
        folder = minari_root.dataset_folder(dataset) / "data"
        if not folder.is_dir():
            raise not_in_root(dataset)
        # Read first: where another process replaces the dataset now, the file will not match.
        stated = read_metadata(folder).get("content_sha256")
        dataset = _load(dataset, folder)
    else:
        stated = dataset.storage.metadata.get("content_sha256")
    if dataset.storage.FORMAT != "hdf5":
        raise DatasetError(f"{dataset.id} is stored as {dataset.storage.FORMAT}; valid: hdf5")
    return Source(
        dataset_id=dataset.id,
        file=file_format.main_file(dataset.storage.data_path),
        episodes=[int(index) for index in dataset.episode_indices],
        storage=dataset.storage,
        env_spec=dataset.env_spec,
        content_sha256=stated,
    )


def _load(dataset_id: str, data: Path) -> MinariDataset:
    """Load a dataset, but never by making the environment that its metadata names, which may be anything."""
    metadata = read_metadata(data)
    if not all(isinstance(metadata.get(key), str) for key in ("observation_space", "action_space")):
        raise DatasetError(
            f"{dataset_id} does not state its spaces, so that Minari would run what its env_spec names: "
            f"do not load it; see `imujoco verify {dataset_id}`"
        )
    try:
        return MinariDataset(data)
    except Exception as error:  # Minari asserts and raises whatever odd metadata makes it stumble on
        raise DatasetError(
            f"{dataset_id} cannot be loaded: {type(error).__name__}: {str(error)[:200]}"
        ) from None


def check_sources(sources: Sequence[Source]) -> None:
    """Raise a DatasetError unless the sources make one collection."""
    if not sources:
        raise DatasetError("there is nothing to combine: no dataset was given")
    if not any(source.episodes for source in sources):
        raise DatasetError("there is nothing to combine: the datasets hold no episodes")
    robots = {str(source.storage.metadata.get("robot", "unknown")): source.dataset_id for source in sources}
    if len(robots) > 1:
        raise DatasetError(
            "a collection holds one robot, but these are of several: "
            + ", ".join(f"{robot} ({dataset_id})" for robot, dataset_id in robots.items())
        )
    first = sources[0]
    for source in sources[1:]:
        for space in ("observation_space", "action_space"):
            ours, theirs = getattr(first.storage, space), getattr(source.storage, space)
            if ours != theirs:
                raise DatasetError(
                    f"{first.dataset_id} and {source.dataset_id} cannot be combined: "
                    f"their {space.replace('_', ' ')}s differ, {ours} and {theirs}"
                )
