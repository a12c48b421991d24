"""Collections: many datasets of one robot as one Minari dataset.

Stock ``minari.combine_datasets`` refuses datasets whose environments differ, as variants' do, and drops
seeds and episode attributes. Here episodes are copied as they are, or linked to, so that every attribute
stays, and no array is decoded: as bytes where all files are whole and as this package writes them, by HDF5
where not.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from os.path import relpath
from pathlib import Path
from typing import Any

import h5py
from gymnasium.envs.registration import EnvSpec
from minari import MinariDataset
from minari.dataset.minari_storage import MinariStorage

from imujoco_minari.envs.registration import collection_spec, environment_spec
from imujoco_minari.errors import DatasetError, DatasetExistsError, ImujocoError
from imujoco_minari.publishing.joining import Joiner, NotPlainError
from imujoco_minari.publishing.sources import IDENTITY, Source, check_sources, open_source
from imujoco_minari.storage import copying, file_format, minari_root
from imujoco_minari.storage.quiet_file import writing
from imujoco_minari.variants import EXPERT, NAMESPACE, Variant
from imujoco_minari.variants.original import (
    CATALOGUE,
    ORIGINAL,
    OriginalVariant,
    is_original,
    models_of,
    originals_spec,
)
from imujoco_minari.verification.child_process import survives


@dataclass(frozen=True)
class _Written:
    """What was written: what identifies each episode, their steps, what the file says, and its digest."""

    attributes: list[dict[str, Any]]
    steps: int
    said: dict[str, Any]
    sha256: str | None = None


def combine_datasets(
    datasets_to_combine: Sequence[MinariDataset | str],
    new_dataset_id: str,
    *,
    link: bool = False,
    force: bool = False,
) -> MinariDataset:
    """Combine datasets of one robot into a collection and return it.

    Every episode keeps its seed and all its attributes; its ``source`` is the dataset it came from.
    The environment is that of the one variant there is, or one of all variants, which takes
    ``reset(options={"variant": id})``.

    Args:
        datasets_to_combine: datasets or their ids. A filtered or split view goes in as that view.
        new_dataset_id: id of the collection.
        link: refer to the episodes where they lie instead of copying them. Such a collection is made
            at once and takes no space, but lives only as long as its sources.
        force: replace a dataset that has the id.

    Raises:
        DatasetNotFoundError: when an id names no dataset of the Minari root.
        DatasetExistsError: when the new id is taken.
        DatasetError: when there is nothing to combine, or robots or spaces differ.
    """
    folder = minari_root.dataset_folder(new_dataset_id)
    if minari_root.taken(new_dataset_id) and not force:
        raise DatasetExistsError(f"{new_dataset_id} is already there, at {folder}; it was left alone")
    with minari_root.failures_named():
        sources = [open_source(dataset) for dataset in datasets_to_combine]
        check_sources(sources)
    with minari_root.staging(new_dataset_id) as staging_folder, _beside() as threads:
        staged = staging_folder / "dataset"
        staged.mkdir()
        data = staged / "data"
        with _damage_named():
            storage = MinariStorage.new(
                data,
                observation_space=sources[0].storage.observation_space,
                action_space=sources[0].storage.action_space,
            )
            if link:
                written = _link(sources, data, folder / "data")
            else:
                written = _join(sources, data) or _copy(sources, data, threads)
        storage.update_metadata({"total_episodes": len(written.attributes), "total_steps": written.steps})
        # The bytes go to the disk while their digest is taken.
        on_disk = threads.submit(minari_root.sync_file, file_format.main_file(data))
        _describe(sources, data, new_dataset_id, written)
        file_format.seal_files(data, written.sha256)
        on_disk.result()
        minari_root.commit(staged, new_dataset_id, replace=force)
    with minari_root.failures_named():
        return MinariDataset(folder / "data")


def collection_id(robot: str, category: str | None = None, tier: str = EXPERT) -> str:
    """Return the id of a robot's collection, ``imujoco/<robot>-<all or category>[-<tier>]-v0``."""
    suffix = "" if tier == EXPERT else f"-{tier}"
    return f"{NAMESPACE}/{robot}-{category or 'all'}{suffix}-v0"


@contextmanager
def _damage_named() -> Iterator[None]:
    """Turn what h5py raises on a damaged source into a DatasetError; a full disk stays an OSError."""
    try:
        yield
    except (KeyError, ValueError, TypeError, RuntimeError, OSError) as error:
        if isinstance(error, ImujocoError) or (isinstance(error, OSError) and error.errno is not None):
            raise
        raise DatasetError(
            f"a dataset cannot be copied: {str(error)[:200]}; `imujoco verify` finds what is wrong with it"
        ) from None


@contextmanager
def _beside() -> Iterator[ThreadPoolExecutor]:
    """Yield threads for what the operating system does, digests and disks, while this one copies."""
    threads = ThreadPoolExecutor(max(1, (os.cpu_count() or 1) - 1))
    try:
        yield threads
    finally:
        threads.shutdown(cancel_futures=True)


def _screened(sources: Sequence[Source], threads: ThreadPoolExecutor) -> Iterator[Source]:
    """Yield the sources, each when its file has proved harmless."""
    for source, _ in zip(sources, threads.map(_screen, sources), strict=True):
        yield source


def _screen(source: Source) -> None:
    """Raise a DatasetError for a file on which HDF5 may hang or crash; one that is as published is none."""
    stated = source.storage.metadata.get(file_format.FILE_DIGEST)
    if stated != file_format.file_sha256(source.file) and (finding := survives(source.file.parent)):
        raise DatasetError(f"{source.dataset_id} cannot be combined: {finding}")


def _join(sources: Sequence[Source], data: Path) -> _Written | None:
    """Write the episodes as bytes, or return None where one of the sources asks for HDF5."""
    if any(source.episodes != list(range(len(source.episodes))) for source in sources):
        return None
    attributes: list[dict[str, Any]] = []
    steps, digests = 0, list[str]()
    sizes = [source.file.stat().st_size for source in sources]
    episodes = sum(len(source.episodes) for source in sources)
    try:
        with Joiner(file_format.main_file(data), sizes, episodes) as joiner:
            for source in sources:
                layout = joiner.add(source.file)
                if layout.episodes.size != len(source.episodes):
                    return None
                attributes += source.attributes(layout.attributes)
                steps += layout.steps
                digests += layout.digests
            said = _common(attributes) | {"content_sha256": file_format.dataset_sha256(digests)}
            sha256 = joiner.finish(said)
    except NotPlainError:
        return None
    return _Written(attributes, steps, said, sha256)


def _copy(sources: Sequence[Source], data: Path, threads: ThreadPoolExecutor) -> _Written:
    """Copy the episodes by HDF5."""
    attributes: list[dict[str, Any]] = []
    steps, digests = 0, list[str]()
    with writing(file_format.main_file(data), new=True) as target:
        for source in _screened(sources, threads):
            with h5py.File(source.file, "r") as file:
                attributes += source.attributes(file.attrs)
                copied = copying.copy_episodes(file, source.episodes, target, source.dataset_id)
                steps += copied.steps
                digests += copied.digests
        said = _common(attributes) | {"content_sha256": file_format.dataset_sha256(digests)}
        target.attrs.update(said)
    return _Written(attributes, steps, said)


def _link(sources: Sequence[Source], data: Path, linked_from: Path) -> _Written:
    """Write links to the episodes, for a file that will lie in ``linked_from``."""
    attributes: list[dict[str, Any]] = []
    steps = 0
    with writing(file_format.main_file(data), new=True) as target:
        for source in sources:
            with h5py.File(source.file, "r") as file:
                attributes += source.attributes(file.attrs)
                copying.link_episodes(file, source.episodes, target, relpath(source.file, linked_from))
                steps += _steps(source, file)
        said = _common(attributes)
        target.attrs.update(said)
    return _Written(attributes, steps, said)


def _steps(source: Source, file: h5py.File) -> int:
    """Return how many steps a source's episodes have, without opening each where all are in it."""
    metadata = source.storage.metadata
    if len(source.episodes) == metadata["total_episodes"]:
        return int(metadata["total_steps"])
    return sum(int(file[f"episode_{number}"].attrs["total_steps"]) for number in source.episodes)


def _common(attributes: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what all the episodes say alike of what they are of."""
    first = attributes[0]
    return {
        key: first[key]
        for key in IDENTITY
        if key in first and all(attrs is first or attrs.get(key) == first[key] for attrs in attributes)
    }


def _describe(sources: Sequence[Source], data: Path, dataset_id: str, written: _Written) -> None:
    """Write the collection's metadata."""
    attributes = written.attributes
    spec = _env_spec(sources, dataset_id, attributes)
    metadata = {
        "dataset_id": dataset_id,
        "combined_datasets": [source.dataset_id for source in sources],
        "minari_version": version("minari"),
        "algorithm_name": ", ".join(
            sorted({str(s.storage.metadata.get("algorithm_name", "unknown")) for s in sources})
        ),
        "author": set().union(*(s.storage.metadata.get("author", set()) for s in sources)),
        "code_permalink": f"imujoco-minari=={version('imujoco-minari')}",
        "description": f"A collection of {len(attributes)} episodes out of {len(sources)} datasets.",
        **({CATALOGUE: ORIGINAL} if is_original(sources[0].storage.metadata) else {}),
        "requirements": sorted({str(r) for s in sources for r in s.storage.metadata.get("requirements", [])}),
    }
    storage = MinariStorage.read(data)
    if spec is not None:
        metadata["env_spec"] = spec.to_json()
    storage.update_metadata(metadata | {key: _plain(value) for key, value in written.said.items()})
    storage.update_metadata({"dataset_size": storage.get_size()})


def _env_spec(sources: Sequence[Source], dataset_id: str, attributes: list[dict[str, Any]]) -> EnvSpec | None:
    if any(is_original(source.storage.metadata) for source in sources):
        return originals_spec(_collection_name(dataset_id), _original_models(sources))
    names = list(dict.fromkeys(str(attrs["variant"]) for attrs in attributes if "variant" in attrs))
    if len(names) == 1:
        return environment_spec(names[0])
    if names:
        return collection_spec(_collection_name(dataset_id), [Variant.parse(name) for name in names])
    specs = [source.env_spec for source in sources]
    if any(spec != specs[0] for spec in specs):
        raise DatasetError("the datasets are of different environments, and none of them is a variant's")
    return specs[0]


def _collection_name(dataset_id: str) -> str:
    return dataset_id.rpartition("/")[2].rpartition("-v")[0]


def _original_models(sources: Sequence[Source]) -> dict[OriginalVariant, str]:
    """Return the models of sources that all hold the original's variants, whose ids do not imply them."""
    models: dict[OriginalVariant, str] = {}
    for source in sources:
        if not is_original(source.storage.metadata) or source.env_spec is None:
            raise DatasetError(
                f"{source.dataset_id} does not hold the original's variants, as others here do: "
                "their environments differ even where their ids do not, and cannot be combined"
            )
        for variant, mjcf in models_of(source.env_spec.kwargs).items():
            if models.setdefault(variant, mjcf) != mjcf:
                raise DatasetError(
                    f"{source.dataset_id}: its model of {variant} is not that of another source"
                )
    return models


def _plain(value: Any) -> Any:
    """Return an HDF5 attribute as JSON can hold it."""
    return value.item() if hasattr(value, "item") else value
