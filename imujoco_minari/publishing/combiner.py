"""Collections: combines many datasets of one robot into one Minari dataset.

Stock ``minari.combine_datasets`` requires all datasets to share one environment, and drops seeds and episode
attributes. Here HDF5 copies or links whole episodes, so every attribute is kept and no array is decoded.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from os.path import relpath
from pathlib import Path
from typing import Any

from gymnasium.envs.registration import EnvSpec
from minari import MinariDataset
from minari.dataset.minari_storage import MinariStorage

from imujoco_minari.envs.registration import dataset_name, dataset_spec, stored_models
from imujoco_minari.errors import ArgumentError, DatasetError, DatasetExistsError
from imujoco_minari.publishing.sizes import check_space
from imujoco_minari.publishing.sources import (
    Source,
    check_current,
    check_sources,
    open_source,
    reading_errors,
)
from imujoco_minari.storage import copying, file_format, minari_root, transactions
from imujoco_minari.storage.metadata import complete_metadata, provenance
from imujoco_minari.storage.quiet_file import writing
from imujoco_minari.variants.named_collections import NamedCollection
from imujoco_minari.variants.original import CATALOGUE, ORIGINAL, names_variant, variant_of
from imujoco_minari.verification.child_process import survives
from imujoco_minari.verification.findings import plain


def combine_datasets(
    datasets_to_combine: Sequence[MinariDataset | str],
    new_dataset_id: str,
    *,
    link: bool = False,
    force: bool = False,
) -> MinariDataset:
    """Combine datasets of one robot into a collection and return it.

    A collection that exists already and holds what the sources hold now is returned as it is.

    Every episode keeps its seed and all its attributes. Its ``source`` is the dataset that it came from.
    The environment of a collection of several variants selects one by ``reset(options={"variant": id})``.

    Args:
        datasets_to_combine: datasets or their ids. Of a filtered or split view, only its episodes are used.
        new_dataset_id: id of the collection.
        link: link to the episodes of the sources instead of copying them. A linked collection is made at
            once and takes no space, but it breaks if a source is deleted.
        force: replace the dataset that has the id.

    Raises:
        DatasetNotFoundError: if the Minari root has no dataset with one of the ids.
        DatasetExistsError: if another dataset has the id, or the sources have changed since they were
            combined, and ``force`` is false.
        DatasetError: if there are no episodes to combine, if robots or spaces differ, if a linked
            collection would replace a dataset that it links to, or if the id stands for other variants or
            tiers: ``imujoco/hopper-all-v0`` stands for every listed Hopper.
        ArgumentError: if something else than datasets is given.

    Example:
        >>> ids = ["imujoco/hopper-base-v0", "imujoco/hopper-massdec_25_leggeom-v0"]
        >>> combine_datasets(ids, "me/two-hoppers-v0").total_episodes
        200
    """
    folder = minari_root.dataset_folder(new_dataset_id)
    if isinstance(datasets_to_combine, str) or not isinstance(datasets_to_combine, Iterable):
        raise ArgumentError(f"give a list of datasets or their ids, not {type(datasets_to_combine).__name__}")
    # This finishes an interrupted replacement, of a source too, so it comes first.
    taken = transactions.taken(new_dataset_id)
    with minari_root.storage_errors():
        sources = [open_source(dataset) for dataset in datasets_to_combine]
        check_sources(sources)
    if taken and not force:
        check_current(new_dataset_id, sources, link=link)
        return _load(folder)
    if not link:
        check_space(new_dataset_id, sum(source.bytes for source in sources))
    with transactions.staging(new_dataset_id) as staging_folder:
        staged = staging_folder / "dataset"
        staged.mkdir()
        data = staged / "data"
        with reading_errors("a dataset cannot be copied"):
            MinariStorage.new(
                data,
                observation_space=sources[0].observation_space,
                action_space=sources[0].action_space,
            )
            if link and force:
                files = [source.file for source in sources]
                copying.check_replaced(new_dataset_id, file_format.main_file(folder / "data"), files)
            attributes, stated = _write_episodes(sources, data, folder / "data" if link else None)
        complete_metadata(data, _collection_metadata(sources, new_dataset_id, attributes) | stated)
        try:
            transactions.commit(staged, new_dataset_id, replace=force)
        except DatasetExistsError:
            if force:
                raise
            # Another process was faster.
            check_current(new_dataset_id, sources, link=link)
    return _load(folder)


def _load(folder: Path) -> MinariDataset:
    with minari_root.storage_errors():
        return MinariDataset(folder / "data")


def _check_files(sources: Sequence[Source]) -> Iterator[Source]:
    """Check the files of the sources in threads, and yield each source when its file is safe to open."""
    threads = ThreadPoolExecutor(max(1, (os.cpu_count() or 1) - 1))
    try:
        for source, _ in zip(sources, threads.map(_check_file, sources), strict=True):
            yield source
    finally:
        threads.shutdown(cancel_futures=True)


def _check_file(source: Source) -> None:
    """Raise a DatasetError if HDF5 hangs or crashes on the file. A file with its stated digest is safe."""
    try:
        digest = file_format.file_sha256(source.file)
    except FileNotFoundError:
        raise source.deleted() from None
    if digest != source.metadata.get(file_format.FILE_DIGEST) and (finding := survives(source.data)):
        raise DatasetError(f"{source.dataset_id} cannot be combined: {finding}")


def _write_episodes(
    sources: Sequence[Source], data: Path, linked_from: Path | None
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Copy the episodes of all sources into the new file, or link to them from its final folder.

    Returns:
        The identifying attributes of each episode, and the entries of the metadata that describe them.
    """
    attributes: list[dict[str, Any]] = []
    content: list[Any] = []
    steps, link = 0, linked_from is not None
    with writing(file_format.main_file(data), new=True) as target:
        # Linking reads no array, so a damaged file does no harm.
        for source in sources if link else _check_files(sources):
            with source.opened() as links:
                file = links.file
                attributes += source.attributes(file)
                if linked_from is None:
                    copying.copy_episodes(links, source.episodes, target, source.dataset_id)
                else:
                    copying.link_episodes(links, source.episodes, target, relpath(source.file, linked_from))
                content += source.content(file, link=link)
                steps += source.steps(file)
        shared, digest = _shared_attributes(attributes), file_format.collection_digest(content, link=link)
        target.attrs.update(shared if link else shared | digest)
    return attributes, shared | digest | {"total_steps": steps}


def _shared_attributes(attributes: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the identifying attributes that all episodes share."""
    first = attributes[0]
    return {
        key: plain(value)
        for key, value in first.items()
        if all(attrs is first or attrs.get(key) == value for attrs in attributes)
    }


def _collection_metadata(
    sources: Sequence[Source], dataset_id: str, attributes: list[dict[str, Any]]
) -> dict[str, Any]:
    """Return the collection's metadata, without those that describe its episodes."""
    spec = _collection_env_spec(sources, dataset_id, attributes)
    originals = spec is not None and bool(stored_models(spec.kwargs))
    _check_id(dataset_id, attributes, originals)
    algorithms = sorted({str(source.metadata.get("algorithm_name", "unknown")) for source in sources})
    requirements = {str(r) for source in sources for r in source.metadata.get("requirements") or []}
    return {
        **provenance(
            authors={str(author) for source in sources for author in source.metadata.get("author") or []},
            algorithm=", ".join(algorithms),
            description=f"A collection of {len(attributes)} episodes from {len(sources)} datasets.",
        ),
        "requirements": sorted(requirements),
        "dataset_id": dataset_id,
        "combined_datasets": [source.dataset_id for source in sources],
        "total_episodes": len(attributes),
        **({CATALOGUE: ORIGINAL} if originals else {}),
        **({} if spec is None else {"env_spec": spec.to_json()}),
    }


def _check_id(dataset_id: str, attributes: list[dict[str, Any]], originals: bool) -> None:
    """Raise a DatasetError if the id stands for other variants or tiers than those of the episodes."""
    collection = NamedCollection.parse(dataset_id)
    if collection is not None:
        _check_whole(collection, attributes, originals)
    if not names_variant(dataset_id):
        return
    catalogue = {CATALOGUE: ORIGINAL} if originals else {}
    for named in {(str(attrs.get("variant")), str(attrs.get("tier"))) for attrs in attributes}:
        if variant_of({"variant": named[0], **catalogue}).dataset_id(named[1]) != dataset_id:
            raise DatasetError(
                f"{dataset_id} is the id of a variant's dataset, but the sources have episodes of "
                f"the variant {named[0]} and the tier {named[1]}: choose another id"
            )


def _check_whole(collection: NamedCollection, attributes: list[dict[str, Any]], originals: bool) -> None:
    """Raise a DatasetError unless the episodes are of all variants that the collection stands for."""
    names = {str(variant) for variant in collection.variants}
    found = {str(attrs.get("variant")) for attrs in attributes}
    tiers = {str(attrs.get("tier")) for attrs in attributes}
    if found == names and tiers == {collection.tier} and not originals:
        return
    if originals:
        differs = "the sources are of the original archive"
    elif found == names:
        differs = f"the sources have the tiers {', '.join(sorted(tiers))}"
    else:
        words = [f"lack {len(names - found)} of them"] if names - found else []
        words += [f"have {', '.join(sorted(found - names)[:3])} too"] if found - names else []
        differs = f"the sources {' and '.join(words)}"
    raise DatasetError(
        f"{collection.dataset_id} stands for the tier {collection.tier} of all {len(names)} variants of "
        f"{collection.robot}{f' in {collection.category}' if collection.category else ''}, but {differs}: "
        "choose another id"
    )


def _collection_env_spec(
    sources: Sequence[Source], dataset_id: str, attributes: list[dict[str, Any]]
) -> EnvSpec | None:
    models = _original_models(sources)
    names = list(dict.fromkeys(str(attrs["variant"]) for attrs in attributes if "variant" in attrs))
    if names:
        return dataset_spec(dataset_name(dataset_id), names, models)
    specs = [source.env_spec for source in sources]
    if any(spec != specs[0] for spec in specs):
        raise DatasetError("the datasets have different environments, and these are not variants")
    return specs[0]


def _original_models(sources: Sequence[Source]) -> dict[str, str]:
    """Return variant id -> MJCF text for sources of the original archive's variants; empty for others."""
    stored = [stored_models(source.env_spec.kwargs) if source.env_spec else {} for source in sources]
    models: dict[str, str] = {}
    for source, own in zip(sources, stored, strict=True):
        if any(stored) and not own:
            raise DatasetError(
                f"{source.dataset_id} is not from the original's archive, but other sources are: "
                "their environments differ even if their ids are the same, so they cannot be combined"
            )
        for variant, mjcf in own.items():
            if models.setdefault(variant, mjcf) != mjcf:
                raise DatasetError(
                    f"{source.dataset_id}: its model of {variant} differs from that of another source"
                )
    return models
