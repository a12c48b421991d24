"""The sources of a collection: whether they fit together, and whether a collection still holds what they do.

Their metadata are read once, and no code of them is run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
from gymnasium.envs.registration import EnvSpec
from minari import MinariDataset
from minari.serialization import deserialize_space

from imujoco_minari.errors import DatasetError, DatasetExistsError, ImujocoError, check_one_robot, listed
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
        metadata: content of ``metadata.json``, read once. The spaces and ``env_spec`` are from it.
        episodes: numbers of the episodes to use.
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
        return sum(int(attrs["total_steps"]) for attrs in self._attributes(file))

    def content(self, file: h5py.File, *, link: bool) -> list[Any]:
        """Return what the digest of a collection covers of this source: see ``collection_digest``."""
        if not link:
            return [copying.episode_digest(file, number) for number in self.episodes]
        if self.whole and "content_sha256" in self.metadata:
            return [[len(self.episodes), str(self.metadata["content_sha256"])]]
        stored = (attrs.get(file_format.DIGEST, "") for attrs in self._attributes(file))
        return [[len(self.episodes), file_format.dataset_sha256(map(str, stored))]]

    def attributes(self, file: h5py.File) -> list[dict[str, Any]]:
        """Return the identifying attributes of each episode."""
        if all(key in file.attrs for key in file_format.IDENTITY):
            return [{key: file.attrs[key] for key in file_format.IDENTITY}] * len(self.episodes)
        every = self._attributes(file)
        return [{key: attrs[key] for key in file_format.IDENTITY if key in attrs} for attrs in every]

    def _attributes(self, file: h5py.File) -> Iterator[h5py.AttributeManager]:
        return (file[file_format.episode_name(number)].attrs for number in self.episodes)


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
    for key in ("observation_space", "action_space"):
        if not isinstance(metadata.get(key), str):
            # Minari would make the environment to get its space, and that may run any code.
            raise DatasetError(
                f"{view.dataset_id} does not state its {key}, so Minari would run its environment: "
                f"do not load it; see `imujoco verify {view.dataset_id}`"
            )
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
        observation_space=_parsed(view.dataset_id, metadata, "observation_space", deserialize_space),
        action_space=_parsed(view.dataset_id, metadata, "action_space", deserialize_space),
        env_spec=_parsed(view.dataset_id, metadata, "env_spec", EnvSpec.from_json),
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


def check_current(dataset_id: str, sources: Sequence[Source], *, link: bool) -> None:
    """Check that a dataset of the root is the collection that combining (or linking) these sources gives.

    Raises:
        DatasetExistsError: if it is another dataset, or the sources have changed since it was combined.
        DatasetError: if it cannot be read.
    """
    metadata = read_metadata(minari_root.dataset_folder(dataset_id) / "data")
    combined, linked = metadata.get("combined_datasets"), file_format.LINKED in metadata
    ids = [source.dataset_id for source in sources]
    episodes, had = sum(len(source.episodes) for source in sources), metadata.get("total_episodes")
    if not combined or not isinstance(combined, list):
        differs = "already exists and is not a collection"
    elif combined != ids:
        lacks = [name for name in ids if name not in combined]
        more = [name for name in map(str, combined) if name not in ids]
        words = [f"lacks {listed(lacks)}"] if lacks else []
        words += [f"also has {listed(more)}"] if more else []
        differs = f"already combines other datasets: it {' and '.join(words) or 'has another order'}"
    elif linked != link:
        differs = f"already exists, and {'links to' if linked else 'copies'} its episodes"
    elif episodes != had:
        differs = f"is stale: it has {had} episodes, and its sources have {episodes} now"
    else:
        differs = _changed(dataset_id, metadata, sources, link)
    if differs:
        raise DatasetExistsError(f"{dataset_id} {differs}. It was not changed (--force combines it anew)")


def _changed(dataset_id: str, metadata: dict[str, Any], sources: Sequence[Source], link: bool) -> str:
    """Return words for sources that have changed since they were combined; empty if none has."""
    now: list[Any] = []
    with reading_errors(f"{dataset_id} cannot be compared with its sources"):
        for source in sources:
            with source.opened() as links:
                now += source.content(links.file, link=link)
    if file_format.collection_digest(now, link=link).items() <= metadata.items():
        return ""
    # A copy states one digest for all sources.
    then = metadata[file_format.LINKED] if link else None
    changed = []
    if isinstance(then, list):
        changed = [each.dataset_id for each, new in zip(sources, now, strict=True) if new not in then]
    return f"is stale: its sources have changed{f': {listed(changed)}' if changed else ''}"


def _parsed(dataset_id: str, metadata: dict[str, Any], key: str, parse: Callable[[Any], Any]) -> Any:
    """Return a parsed value of the metadata, or None if they state none."""
    try:
        return None if metadata.get(key) is None else parse(metadata[key])
    except Exception as error:  # Minari and Gymnasium raise many kinds of errors on malformed text
        raise DatasetError(
            f"{dataset_id} cannot be loaded: its {key} is malformed: {str(error)[:200]}"
        ) from None


@contextmanager
def reading_errors(message: str) -> Iterator[None]:
    """Turn h5py's errors on a damaged file into a DatasetError. A full disk stays an OSError."""
    try:
        yield
    except (KeyError, ValueError, TypeError, RuntimeError, OSError) as error:
        if isinstance(error, ImujocoError) or (isinstance(error, OSError) and error.errno is not None):
            raise
        raise DatasetError(
            f"{message}: {str(error)[:200]}; `imujoco verify` finds what is wrong with it"
        ) from None
