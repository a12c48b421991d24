"""Which episodes: of which datasets, with which attributes, and which share of them.

A share is drawn by episode, from each variant and tier by itself, and depends on the seed, the variant
and the tier alone: an episode is on the same side of a split whether its dataset is read alone, with
others, or as part of a collection.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from imujoco_minari.errors import DatasetError, VariantError, suggestion
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.storage.missing import not_in_root
from imujoco_minari.storage.reader import EpisodeFile

if TYPE_CHECKING:
    from typing import TypeAlias

    from minari import MinariDataset

    Datasets: TypeAlias = str | MinariDataset | Sequence[str | MinariDataset]


@dataclass(frozen=True, order=True)
class Origin:
    """Where an episode comes from: its variant, taken apart, and its tier; empty where it is not known."""

    variant: str = ""
    robot: str = ""
    category: str = ""
    body: str = ""
    percent: int = 0
    tier: str = ""


ATTRIBUTES = tuple(field.name for field in fields(Origin))


@dataclass(frozen=True)
class Source:
    """One dataset, or view of one.

    Attributes:
        dataset_id: its id.
        file: its ``main_data.hdf5``.
        episodes: numbers of the episodes in the view; None for all.
    """

    dataset_id: str
    file: Path
    episodes: tuple[int, ...] | None = None


@dataclass(frozen=True)
class Episode:
    """One episode: in which source, under which number, from where."""

    source: Source
    number: int
    origin: Origin


def sources(datasets: Datasets) -> list[Source]:
    """Return the sources that ids or datasets name.

    Raises:
        DatasetNotFoundError: when an id names no dataset of the Minari root.
        DatasetError: when there are none, or one is not stored as HDF5.
    """
    if isinstance(datasets, str) or not isinstance(datasets, Iterable) or hasattr(datasets, "storage"):
        datasets = [datasets]
    found = [_source(dataset) for dataset in datasets]
    if not found:
        raise DatasetError("no dataset was given")
    return found


def _source(dataset: Any) -> Source:
    if isinstance(dataset, str):
        folder = minari_root.dataset_folder(dataset)
        file = file_format.main_file(folder / "data")
        if not folder.exists():
            raise not_in_root(dataset)
        if not file.is_file():
            raise DatasetError(f"{dataset} is not stored as HDF5: it has no {file.name}")
        return Source(dataset, file)
    if not hasattr(dataset, "storage"):
        raise DatasetError(f"a dataset is a Minari dataset or its id, not {type(dataset).__name__}")
    if dataset.storage.FORMAT != "hdf5":
        raise DatasetError(f"{dataset.id} is stored as {dataset.storage.FORMAT}; valid: hdf5")
    chosen = tuple(int(number) for number in dataset.episode_indices)
    everything = chosen == tuple(range(dataset.storage.total_episodes))
    file = file_format.main_file(dataset.storage.data_path)
    return Source(dataset.id, file, None if everything else chosen)


def episodes(source: Source, file: EpisodeFile) -> list[Episode]:
    """Return the episodes of a source, in its order, each with its origin."""
    root = file.attributes
    shared = {name: root[name] for name in ATTRIBUTES if name in root}
    varying = [name for name in ATTRIBUTES if name not in shared]
    if "variant" in shared and "tier" in shared:
        # The dataset is of one variant, and its episodes say nothing else.
        varying = []
    known: dict[tuple[Any, ...], Origin] = {}
    found = []
    for number in file.numbers() if source.episodes is None else source.episodes:
        attributes = shared | (file.episode_attributes(number, varying) if varying else {})
        key = tuple(attributes.items())
        if key not in known:
            known[key] = _origin(attributes)
        found.append(Episode(source, number, known[key]))
    return found


def _origin(attributes: Mapping[str, Any]) -> Origin:
    words = {name: str(value) for name, value in attributes.items() if name != "percent"}
    return Origin(percent=int(attributes.get("percent", 0)), **words)


def matching(found: Sequence[Episode], where: Mapping[str, Any]) -> list[Episode]:
    """Return the episodes whose attributes are ``where``'s values, or among them where it gives several.

    Raises:
        VariantError: when ``where`` has an unknown key, or a value that no episode has.
    """
    chosen = list(found)
    for name, wanted in where.items():
        if name not in ATTRIBUTES:
            raise VariantError(
                f"unknown attribute {name!r}{suggestion(str(name), ATTRIBUTES)}; "
                f"valid: {', '.join(ATTRIBUTES)}"
            )
        several = isinstance(wanted, Collection) and not isinstance(wanted, str)
        values = set(wanted) if several else {wanted}
        present = {getattr(episode.origin, name) for episode in found}
        missing = sorted(values - present, key=str)
        if missing and not (several and values & present):
            near = suggestion(str(missing[0]), map(str, present))
            raise VariantError(
                f"no episode has the {name} {missing[0]!r}{near}; "
                f"there are: {', '.join(map(str, sorted(present)))}"
            )
        chosen = [episode for episode in chosen if getattr(episode.origin, name) in values]
    if not chosen:
        raise VariantError(
            "no episode has all of "
            + ", ".join(f"{name} {wanted!r}" for name, wanted in where.items())
            + ", though each alone has some"
        )
    return chosen


def portion_of(origins: Sequence[Origin], portion: tuple[float, float], seed: int) -> list[int]:
    """Return which episodes make a share of each origin's, in their order.

    Args:
        origins: of each episode.
        portion: from and to, of the episodes shuffled by ``seed``; (0, 0.75) and (0.75, 1) make two
            disjoint shares that together are all.
        seed: of the shuffle.

    Raises:
        DatasetError: when ``portion`` is no part of [0, 1], or no episode falls into it.
    """
    low, high = portion
    if not 0 <= low < high <= 1:
        raise DatasetError(f"portion must lie in 0 to 1, as (0.0, 0.75) does, not {portion}")
    if (low, high) == (0, 1):
        return list(range(len(origins)))
    chosen: list[int] = []
    for order in shuffled(origins, seed):
        chosen += order[int(low * len(order) + 0.5) : int(high * len(order) + 0.5)]
    if not chosen:
        raise DatasetError(f"no episode falls into the portion {portion} of {len(origins)}")
    return sorted(chosen)


def shuffled(origins: Sequence[Origin], seed: int) -> Iterator[list[int]]:
    """Yield, for each origin, which episodes are its, in an order drawn by ``seed``.

    Raises:
        DatasetError: when the seed is negative.
    """
    if seed < 0:
        raise DatasetError(f"a seed is not negative, as {seed} is")
    places: dict[Origin, list[int]] = {}
    for place, origin in enumerate(origins):
        places.setdefault(origin, []).append(place)
    for origin, members in places.items():
        digest = hashlib.sha256(f"{origin.variant} {origin.tier}".encode()).digest()
        rng = np.random.default_rng([seed, int.from_bytes(digest[:8], "little")])
        yield [members[i] for i in rng.permutation(len(members))]
