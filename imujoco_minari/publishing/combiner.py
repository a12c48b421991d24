"""Collections: many datasets of one robot as one Minari dataset.

Stock ``minari.combine_datasets`` refuses datasets whose environments differ, as variants' do, and drops
seeds and episode attributes. Here HDF5 copies or links whole episodes, so every attribute stays and no array
is decoded.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from os.path import relpath
from pathlib import Path
from typing import Any

import h5py
from gymnasium.envs.registration import EnvSpec
from minari import MinariDataset
from minari.dataset.minari_storage import MinariStorage

from imujoco_minari.envs.registration import dataset_spec, stored_models
from imujoco_minari.errors import DatasetError, DatasetExistsError, ImujocoError
from imujoco_minari.publishing.sources import Source, check_sources, open_source
from imujoco_minari.storage import copying, file_format, minari_root
from imujoco_minari.storage.metadata import complete_metadata, provenance
from imujoco_minari.storage.quiet_file import writing
from imujoco_minari.variants import EXPERT, NAMESPACE
from imujoco_minari.variants.original import CATALOGUE, ORIGINAL
from imujoco_minari.verification.child_process import survives


@dataclass(frozen=True)
class _Written:
    """What was written.

    Attributes:
        attributes: the identifying attributes of each episode.
        steps: number of steps of all episodes.
        stated: what the metadata state of the content.
    """

    attributes: list[dict[str, Any]]
    steps: int
    stated: dict[str, Any]


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
        DatasetError: when there is nothing to combine, robots or spaces differ, or a linked collection
            would replace a dataset that it links to.
    """
    folder = minari_root.dataset_folder(new_dataset_id)
    if minari_root.taken(new_dataset_id) and not force:
        raise DatasetExistsError(f"{new_dataset_id} is already there, at {folder}; it was left alone")
    with minari_root.failures_named():
        sources = [open_source(dataset) for dataset in datasets_to_combine]
        check_sources(sources)
    with minari_root.staging(new_dataset_id) as staging_folder:
        staged = staging_folder / "dataset"
        staged.mkdir()
        data = staged / "data"
        with _damage_named():
            MinariStorage.new(
                data,
                observation_space=sources[0].observation_space,
                action_space=sources[0].action_space,
            )
            if link:
                if force:
                    files = [source.file for source in sources]
                    copying.check_replaced(new_dataset_id, file_format.main_file(folder / "data"), files)
                written = _link(sources, data, folder / "data")
            else:
                written = _copy(sources, data)
        complete_metadata(data, _metadata(sources, new_dataset_id, written))
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


def _screened(sources: Sequence[Source]) -> Iterator[Source]:
    """Yield the sources, each when its file has proved harmless to HDF5."""
    threads = ThreadPoolExecutor(max(1, (os.cpu_count() or 1) - 1))
    try:
        for source, _ in zip(sources, threads.map(_screen, sources), strict=True):
            yield source
    finally:
        threads.shutdown(cancel_futures=True)


def _screen(source: Source) -> None:
    """Raise a DatasetError for a file on which HDF5 may hang or crash; a file as it was published is none."""
    try:
        digest = file_format.file_sha256(source.file)
    except FileNotFoundError:
        raise DatasetError(
            f"{source.dataset_id} was deleted while it was read: nothing was combined"
        ) from None
    if digest != source.metadata.get(file_format.FILE_DIGEST) and (finding := survives(source.data)):
        raise DatasetError(f"{source.dataset_id} cannot be combined: {finding}")


def _copy(sources: Sequence[Source], data: Path) -> _Written:
    """Copy the episodes into the new file."""
    attributes: list[dict[str, Any]] = []
    steps, digests = 0, list[str]()
    with writing(file_format.main_file(data), new=True) as target:
        for source in _screened(sources):
            with source.opened() as file:
                attributes += source.attributes(file)
                copied = copying.copy_episodes(file, source.episodes, target, source.dataset_id)
                steps += copied.steps
                digests += copied.digests
        stated = _common(attributes) | {"content_sha256": file_format.dataset_sha256(digests)}
        target.attrs.update(stated)
    return _Written(attributes, steps, stated)


def _link(sources: Sequence[Source], data: Path, linked_from: Path) -> _Written:
    """Write links to the episodes, for a file that will lie in ``linked_from``."""
    attributes: list[dict[str, Any]] = []
    steps, linked = 0, list[list[Any]]()
    with writing(file_format.main_file(data), new=True) as target:
        for source in sources:
            with source.opened() as file:
                attributes += source.attributes(file)
                copying.link_episodes(file, source.episodes, target, relpath(source.file, linked_from))
                steps += _steps(source, file)
                linked.append([len(source.episodes), _content(source, file)])
        stated = _common(attributes)
        target.attrs.update(stated)
    return _Written(attributes, steps, stated | {file_format.LINKED: linked})


def _steps(source: Source, file: h5py.File) -> int:
    """Return how many steps the source's episodes have, without opening each if all go in."""
    if source.whole:
        return int(source.metadata["total_steps"])
    return sum(int(file[f"episode_{number}"].attrs["total_steps"]) for number in source.episodes)


def _content(source: Source, file: h5py.File) -> str:
    """Return the digest of the source's episodes, without opening each if all go in."""
    if source.whole and "content_sha256" in source.metadata:
        return str(source.metadata["content_sha256"])
    digests = (file[f"episode_{number}"].attrs.get(file_format.DIGEST, "") for number in source.episodes)
    return file_format.dataset_sha256(map(str, digests))


def _common(attributes: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the identifying attributes that all episodes share."""
    first = attributes[0]
    return {
        key: first[key]
        for key in file_format.IDENTITY
        if key in first and all(attrs is first or attrs.get(key) == first[key] for attrs in attributes)
    }


def _metadata(sources: Sequence[Source], dataset_id: str, written: _Written) -> dict[str, Any]:
    """Return the collection's metadata."""
    attributes = written.attributes
    spec = _env_spec(sources, dataset_id, attributes)
    algorithms = sorted({str(source.metadata.get("algorithm_name", "unknown")) for source in sources})
    requirements = {str(r) for source in sources for r in source.metadata.get("requirements") or []}
    return {
        **provenance(
            authors={str(author) for source in sources for author in source.metadata.get("author") or []},
            algorithm=", ".join(algorithms),
            description=f"A collection of {len(attributes)} episodes out of {len(sources)} datasets.",
        ),
        "requirements": sorted(requirements),
        "dataset_id": dataset_id,
        "combined_datasets": [source.dataset_id for source in sources],
        "total_episodes": len(attributes),
        "total_steps": written.steps,
        **({CATALOGUE: ORIGINAL} if spec is not None and stored_models(spec.kwargs) else {}),
        **({} if spec is None else {"env_spec": spec.to_json()}),
        **{key: _plain(value) for key, value in written.stated.items()},
    }


def _env_spec(sources: Sequence[Source], dataset_id: str, attributes: list[dict[str, Any]]) -> EnvSpec | None:
    models = _models(sources)
    names = list(dict.fromkeys(str(attrs["variant"]) for attrs in attributes if "variant" in attrs))
    if names:
        return dataset_spec(_collection_name(dataset_id), names, models)
    specs = [source.env_spec for source in sources]
    if any(spec != specs[0] for spec in specs):
        raise DatasetError("the datasets are of different environments, and none of them is a variant's")
    return specs[0]


def _collection_name(dataset_id: str) -> str:
    return dataset_id.rpartition("/")[2].rpartition("-v")[0]


def _models(sources: Sequence[Source]) -> dict[str, str]:
    """Return variant id -> MJCF text for sources of the original archive's variants; empty for others."""
    stored = [stored_models(source.env_spec.kwargs) if source.env_spec else {} for source in sources]
    models: dict[str, str] = {}
    for source, own in zip(sources, stored, strict=True):
        if any(stored) and not own:
            raise DatasetError(
                f"{source.dataset_id} does not hold the original's variants, as others here do: "
                "their environments differ even where their ids do not, and cannot be combined"
            )
        for variant, mjcf in own.items():
            if models.setdefault(variant, mjcf) != mjcf:
                raise DatasetError(
                    f"{source.dataset_id}: its model of {variant} is not that of another source"
                )
    return models


def _plain(value: Any) -> Any:
    """Return an HDF5 attribute as JSON can hold it."""
    return value.item() if hasattr(value, "item") else value
