"""The sources of a collection: reads their metadata once, runs no code of them, checks that they fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
from gymnasium.envs.registration import EnvSpec
from minari import MinariDataset
from minari.serialization import deserialize_space

from imujoco_minari.errors import DatasetError, check_one_robot
from imujoco_minari.loading.selection import view_of
from imujoco_minari.storage import copying, file_format, minari_root
from imujoco_minari.storage.containment import LinkedFiles
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.verification.findings import same


@dataclass(frozen=True)
class Source:
    """A dataset, or some episodes of it, that goes into a collection.

    Attributes:
        dataset_id: id of the dataset.
        data: ``data`` folder of the dataset.
        folder: device and inode of that folder. They change if the dataset is replaced.
        metadata: content of ``metadata.json``, read once.
        episodes: numbers of the episodes to use.
        observation_space: observation space, from the metadata.
        action_space: action space, from the metadata.
        env_spec: specification of the environment, from the metadata; None if it states none.
    """

    dataset_id: str
    data: Path
    folder: tuple[int, int]
    metadata: dict[str, Any]
    episodes: Sequence[int]
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    env_spec: EnvSpec | None

    @property
    def bytes(self) -> int:
        """About how many bytes the episodes take; 0 where it cannot be read, which copying reports."""
        try:
            share = len(self.episodes) / max(1, int(self.metadata["total_episodes"]))
            return round(share * self.file.stat().st_size)
        except (OSError, OverflowError):
            return 0

    @property
    def file(self) -> Path:
        """The HDF5 file of the dataset."""
        return file_format.main_file(self.data)

    @property
    def whole(self) -> bool:
        """Whether all episodes of the dataset are used, in their order."""
        return list(self.episodes) == list(range(int(self.metadata.get("total_episodes", -1))))

    @contextmanager
    def opened(self) -> Iterator[LinkedFiles]:
        """Open the HDF5 file and check that it belongs to the metadata.

        Raises:
            DatasetError: if the dataset was replaced or deleted after its metadata were read.
        """
        try:
            with LinkedFiles(self.file) as links:
                file = links.file
                same_folder = self.folder == minari_root.folder_identity(self.data)
                digest = self.metadata.get("content_sha256")
                if not same_folder or not same(file.attrs.get("content_sha256"), digest):
                    raise DatasetError(
                        f"{self.dataset_id} was replaced while it was read: nothing was combined; try again"
                    )
                if len(file) != self.metadata["total_episodes"]:
                    raise DatasetError(
                        f"{self.dataset_id} states {self.metadata['total_episodes']} episodes, but its file "
                        f"holds {len(file)}: see `imujoco verify {self.dataset_id}`"
                    )
                yield links
        except FileNotFoundError:
            raise self.deleted() from None

    def deleted(self) -> DatasetError:
        """Return the error for a source that another process deleted."""
        return DatasetError(f"{self.dataset_id} was deleted while it was read: nothing was combined")

    def steps(self, file: h5py.File) -> int:
        """Return the number of steps of its episodes; from its metadata if all of them are used."""
        if self.whole:
            return int(self.metadata["total_steps"])
        groups = (file[file_format.episode_name(number)] for number in self.episodes)
        return sum(int(group.attrs["total_steps"]) for group in groups)

    def content(self, file: h5py.File, *, link: bool) -> list[Any]:
        """Return what the digest of a collection covers of this source: see ``collection_digest``."""
        if link:
            return [[len(self.episodes), self._digest(file)]]
        return [copying.episode_digest(file, number) for number in self.episodes]

    def _digest(self, file: h5py.File) -> str:
        """Return the digest of its episodes; from its metadata if all of them are used."""
        if self.whole and "content_sha256" in self.metadata:
            return str(self.metadata["content_sha256"])
        groups = (file[file_format.episode_name(number)] for number in self.episodes)
        return file_format.dataset_sha256(str(group.attrs.get(file_format.DIGEST, "")) for group in groups)

    def attributes(self, file: h5py.File) -> list[dict[str, Any]]:
        """Return the identifying attributes of each episode."""
        if all(key in file.attrs for key in file_format.IDENTITY):
            return [{key: file.attrs[key] for key in file_format.IDENTITY}] * len(self.episodes)
        groups = (file[file_format.episode_name(number)].attrs for number in self.episodes)
        return [{key: attrs[key] for key in file_format.IDENTITY if key in attrs} for attrs in groups]


def open_source(dataset: MinariDataset | str) -> Source:
    """Return a dataset, or the dataset with this id, as a source.

    Raises:
        DatasetNotFoundError: if the Minari root has no dataset with the id.
        ArgumentError: if it is neither.
        DatasetError: if the dataset is not HDF5, its metadata is malformed, or loading it would run code
            that its metadata names.
    """
    view = view_of(dataset)
    data = view.file.parent
    folder, metadata = minari_root.folder_identity(data), read_metadata(data)
    spaces = [_read_space(view.dataset_id, metadata, key) for key in ("observation_space", "action_space")]
    total = metadata.get("total_episodes")
    if not isinstance(total, int):
        raise DatasetError(
            f"{view.dataset_id} does not state its number of episodes; see `imujoco verify {view.dataset_id}`"
        )
    for key in ("author", "requirements"):
        if not isinstance(metadata.get(key) or [], list):
            raise DatasetError(f"{view.dataset_id} cannot be combined: its {key} is not a list of texts")
    return Source(
        dataset_id=view.dataset_id,
        data=data,
        folder=folder,
        metadata=metadata,
        episodes=range(total) if view.episodes is None else view.episodes,
        observation_space=spaces[0],
        action_space=spaces[1],
        env_spec=_read_env_spec(view.dataset_id, metadata),
    )


def check_sources(sources: Sequence[Source]) -> None:
    """Raise a DatasetError if there are no episodes, or if the robots or the spaces of the sources differ."""
    if not sources:
        raise DatasetError("nothing to combine: no dataset was given")
    if not any(source.episodes for source in sources):
        raise DatasetError("nothing to combine: the datasets have no episodes")
    robots = [(str(source.metadata.get("robot", "")), source.dataset_id) for source in sources]
    check_one_robot(robots, "a collection holds")
    first = sources[0]
    for source in sources[1:]:
        for name in ("observation_space", "action_space"):
            ours, theirs = getattr(first, name), getattr(source, name)
            if ours != theirs:
                raise DatasetError(
                    f"{first.dataset_id} and {source.dataset_id} cannot be combined: "
                    f"their {name.replace('_', ' ')}s differ, {ours} and {theirs}"
                )


def _read_space(dataset_id: str, metadata: dict[str, Any], key: str) -> gym.Space[Any]:
    text = metadata.get(key)
    if not isinstance(text, str):
        # Minari would make the environment to get its space, and that may run any code.
        raise DatasetError(
            f"{dataset_id} does not state its {key}, so Minari would run its environment: "
            f"do not load it; see `imujoco verify {dataset_id}`"
        )
    try:
        space: gym.Space[Any] = deserialize_space(text)
    except Exception as error:  # Minari raises many kinds of errors on malformed text
        raise DatasetError(
            f"{dataset_id} cannot be loaded: its {key} is malformed: {str(error)[:200]}"
        ) from None
    return space


def _read_env_spec(dataset_id: str, metadata: dict[str, Any]) -> EnvSpec | None:
    text = metadata.get("env_spec")
    if text is None:
        return None
    try:
        return EnvSpec.from_json(text)
    except Exception as error:  # as above
        raise DatasetError(
            f"{dataset_id} cannot be loaded: its env_spec is malformed: {str(error)[:200]}"
        ) from None
