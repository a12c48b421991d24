"""From staged episodes to a dataset in the Minari root: complete, check, commit.

A dataset is made in a staging folder of the root and committed after it was checked. An interrupted
publication is never visible.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
from gymnasium.envs.registration import EnvSpec
from minari.data_collector import EpisodeBuffer

from imujoco_minari.envs.mjcf import mjcf_sha256
from imujoco_minari.errors import DatasetError, DatasetExistsError, clipped
from imujoco_minari.publishing.outcome import Published
from imujoco_minari.storage import file_format, minari_root, transactions
from imujoco_minari.storage.metadata import complete_metadata, read_metadata
from imujoco_minari.storage.quiet_file import writing
from imujoco_minari.storage.writer import EpisodeWriter
from imujoco_minari.verification import inspect

# Metadata keys that identify the origin of given episodes.
_ORIGIN_KEYS = ("source", "source_sha256", "seed", "policy_sha256")


@dataclass(frozen=True)
class NewDataset:
    """A dataset to be published, without its episodes.

    Attributes:
        dataset_id: the dataset's id.
        attributes: attributes of the file and of every episode.
        mjcf: the MJCF text of its environment.
        metadata: the entries of ``metadata.json`` that do not follow from the episodes.
    """

    dataset_id: str
    attributes: Mapping[str, Any]
    mjcf: str
    metadata: Mapping[str, Any]


def publish_episodes(
    dataset: NewDataset, spec: EnvSpec, episodes: Iterable[EpisodeBuffer], *, force: bool = False
) -> Published:
    """Publish given episodes, in order, as a dataset.

    Args:
        dataset: the dataset, without its episodes.
        spec: specification of the environment that the dataset recovers.
        episodes: the episodes.
        force: replace the dataset that has the id.

    Raises:
        DatasetExistsError: if the root has another dataset with this id and ``force`` is false.
        StorageError: if the root cannot be written.
        DatasetError: if the check of the new dataset fails.
    """
    origin = {key: dataset.metadata[key] for key in _ORIGIN_KEYS if key in dataset.metadata}
    if found := find_published(dataset.dataset_id, origin, force=force):
        return found

    def write(data: Path) -> None:
        with EpisodeWriter(data, spec, lambda seed: dataset.attributes) as writer:
            for episode in episodes:
                writer.add(episode)

    return publish_written(dataset, write, origin, force=force)


def publish_written(
    dataset: NewDataset, write: Callable[[Path], object], asked: Mapping[str, Any], *, force: bool
) -> Published:
    """Publish a dataset as :func:`publish_episodes` does.

    Args:
        dataset: the dataset, without its episodes.
        write: writes the episodes, as a Minari storage, into the new folder that it is given.
        asked: see :func:`find_published`. A dataset that another process publishes meanwhile must have it.
        force: replace the dataset that has the id.
    """
    start = time.monotonic()
    with transactions.staging(dataset.dataset_id) as folder:
        staged = folder / "dataset"
        staged.mkdir()
        write(staged / "data")
        created = _check_and_commit(staged, dataset, force)
    if not created:
        find_published(dataset.dataset_id, asked, force=False)
    return _read_outcome(dataset.dataset_id, created=created, seconds=time.monotonic() - start)


def find_published(dataset_id: str, asked: Mapping[str, Any], *, force: bool) -> Published | None:
    """Return the outcome if the root has the requested dataset already; None if it is to be made.

    Args:
        dataset_id: the dataset's id.
        asked: metadata that distinguish the requested dataset from others with the same id.
        force: replace what exists, so the answer is None.

    Raises:
        DatasetExistsError: if the dataset with this id differs from the requested one, or is a collection.
        DatasetError: if it is not a complete dataset of this package.
    """
    if force or not transactions.taken(dataset_id):
        return None
    found = _read_outcome(dataset_id, created=False)
    stated = read_metadata(minari_root.dataset_folder(dataset_id) / "data")
    differing = {key: value for key, value in asked.items() if stated.get(key) != value}
    if differing:
        has = ", ".join(_format_value(key, stated.get(key)) for key in differing)
        wanted = ", ".join(_format_value(key, value) for key, value in differing.items())
        raise DatasetExistsError(
            f"{dataset_id} is already published, but differs: it has {has}; you asked for {wanted}. "
            f"Replace it with --force (force=True), delete it with `imujoco delete {dataset_id}`, "
            "or choose another tier"
        )
    return found


def _format_value(key: str, value: Any) -> str:
    """Return a value of the metadata as text for a message."""
    name = key.removesuffix("_sha256")
    if value is None:
        return f"no {name}"
    if key == "total_episodes":
        return f"{value} episodes"
    if key == "policy_deterministic":
        return "deterministic actions" if value else "sampled actions"
    return f"{name} {clipped(value)}"


def _check_and_commit(staged: Path, dataset: NewDataset, force: bool) -> bool:
    """Complete, check and commit a staged dataset; return False if another process was faster."""
    data, dataset_id = staged / "data", dataset.dataset_id
    with writing(file_format.main_file(data)) as file:
        digests = {
            "mjcf_sha256": mjcf_sha256(dataset.mjcf),
            "content_sha256": file_format.content_sha256(file, len(file)),
        }
        file.attrs.update({**dataset.attributes, "mjcf": dataset.mjcf, **digests})
        returns = [float(file[name].attrs["rewards_sum"]) for name in file]
        steps = sum(int(file[name].attrs["total_steps"]) for name in file)
    own = {"dataset_id": dataset_id, "total_episodes": len(returns), "total_steps": steps}
    stated = {**dataset.metadata, **dataset.attributes, **digests, **file_format.return_statistics(returns)}
    complete_metadata(data, stated | own)
    findings = inspect(data, replay_episodes=1)
    if findings:
        raise DatasetError(f"{dataset_id}: not published, because its check found: {findings[0]}")
    try:
        transactions.commit(staged, dataset_id, replace=force)
    except DatasetExistsError:
        if force:
            raise
        return False
    return True


def _read_outcome(dataset_id: str, *, created: bool, seconds: float = 0.0) -> Published:
    """Return the outcome of publishing a dataset that now is in the root."""
    path = minari_root.dataset_folder(dataset_id)
    try:
        with h5py.File(file_format.main_file(path / "data"), "r") as file:
            returns = [float(file[name].attrs["rewards_sum"]) for name in file]
            steps = sum(int(file[name].attrs["total_steps"]) for name in file)
            digest = str(file.attrs.get("content_sha256", ""))
        if not returns:
            raise ValueError("it has no episodes")
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise DatasetError(
            f"{dataset_id}: {path} exists, but is not a complete dataset of this package: {error}"
        ) from None
    statistics = file_format.return_statistics(returns)
    return Published(
        dataset_id,
        path,
        created=created,
        episodes=len(returns),
        steps=steps,
        return_mean=statistics["return_mean"],
        return_std=statistics["return_std"],
        content_sha256=digest,
        seconds=seconds,
    )
