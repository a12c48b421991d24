"""Which episodes to load: from which datasets, with which attributes, and which share of them.

A share is drawn by episode, separately for each variant and tier. It depends only on the seed, the variant
and the tier. An episode is therefore on the same side of a split whether its dataset is loaded alone, with
others, or as part of a collection.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from imujoco_minari.errors import (
    ArgumentError,
    DatasetError,
    VariantError,
    clipped,
    listed,
    suggestion,
    unknown,
    whole_number,
)
from imujoco_minari.short_repr import short_repr
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.storage.missing import not_in_root
from imujoco_minari.storage.reader import EpisodeFile

if TYPE_CHECKING:
    from minari import MinariDataset

Datasets: TypeAlias = "str | MinariDataset | Sequence[str | MinariDataset]"


@dataclass(frozen=True, order=True)
class Origin:
    """The variant of an episode, with its parts, and the tier; empty where they are not known."""

    variant: str = ""
    robot: str = ""
    category: str = ""
    body: str = ""
    percent: float = 0
    tier: str = ""
    changes: str = ""

    __repr__ = short_repr


ATTRIBUTES = tuple(field.name for field in fields(Origin))
# The valid values that an error lists. More than a robot has listed variants; drawn variants are many more.
SHOWN_VALUES = 100


@dataclass(frozen=True)
class View:
    """A dataset, or some of its episodes.

    Attributes:
        dataset_id: the id of the dataset.
        file: its ``main_data.hdf5``.
        episodes: the numbers of the episodes in the view; None for all.
    """

    dataset_id: str
    file: Path
    episodes: tuple[int, ...] | None = None


@dataclass(frozen=True)
class EpisodeReference:
    """One stored episode: the file that has it, its number in the file, and its origin."""

    file: EpisodeFile
    number: int
    origin: Origin


def views(datasets: Datasets) -> list[View]:
    """Return a view for each id or dataset.

    Raises:
        DatasetNotFoundError: when a dataset is not in the Minari root.
        ArgumentError: when no dataset, or something else is given.
        DatasetError: when one is not stored as HDF5.
    """
    if isinstance(datasets, str) or not isinstance(datasets, Iterable) or hasattr(datasets, "storage"):
        datasets = [datasets]
    found = [view_of(dataset) for dataset in datasets]
    if not found:
        raise ArgumentError("no dataset was given")
    return found


def view_of(dataset: Any) -> View:
    """Return a view for an id or a dataset, as :func:`views` does."""
    if isinstance(dataset, str):
        return View(dataset, _main_file(dataset, minari_root.dataset_folder(dataset) / "data"))
    if not hasattr(dataset, "storage"):
        raise ArgumentError(f"a dataset is a Minari dataset or its id, not {type(dataset).__name__}")
    if dataset.storage.FORMAT != "hdf5":
        raise DatasetError(f"{dataset.id} is stored as {dataset.storage.FORMAT}; valid: hdf5")
    file = _main_file(dataset.id, Path(dataset.storage.data_path))
    chosen = tuple(int(number) for number in dataset.episode_indices)
    everything = chosen == tuple(range(dataset.storage.total_episodes))
    return View(dataset.id, file, None if everything else chosen)


def _main_file(dataset_id: str, data: Path) -> Path:
    if not data.is_dir():
        raise not_in_root(dataset_id)
    file = file_format.main_file(data)
    if not file.is_file():
        raise DatasetError(f"{dataset_id} is not stored as HDF5: it has no {file.name}")
    return file


def episodes(view: View, file: EpisodeFile) -> list[EpisodeReference]:
    """Return the episodes of a view, in its order.

    Raises:
        DatasetError: when an attribute of an episode has a wrong type.
    """
    root = file.attributes
    shared = {name: root[name] for name in ATTRIBUTES if name in root}
    varying = [name for name in ATTRIBUTES if name not in shared]
    if "variant" in shared and "tier" in shared:
        # The dataset is of one variant, so its episodes have no attributes that differ.
        varying = []
    known: dict[tuple[Any, ...], Origin] = {}
    found = []
    for number in file.numbers() if view.episodes is None else view.episodes:
        attributes = shared | (file.episode_attributes(number, varying) if varying else {})
        key = tuple(attributes.items())
        try:
            if key not in known:
                known[key] = _origin(attributes)
        except (TypeError, ValueError):
            raise DatasetError(
                f"{view.dataset_id}: episode {number} has attributes that are not text, or a percent "
                "that is not a number"
            ) from None
        found.append(EpisodeReference(file, number, known[key]))
    return found


def _origin(attributes: Mapping[str, Any]) -> Origin:
    words = {name: str(value) for name, value in attributes.items() if name != "percent"}
    percent = float(attributes.get("percent", 0))
    return Origin(percent=int(percent) if percent.is_integer() else percent, **words)


def matching(found: Sequence[EpisodeReference], where: Mapping[str, Any]) -> list[EpisodeReference]:
    """Return the episodes that have, for each attribute in ``where``, the value or one of the values.

    Raises:
        VariantError: when ``where`` is not a mapping, or has an unknown attribute or a value that no
            episode has.
    """
    if not isinstance(where, Mapping):
        raise VariantError(
            f"where must map attributes to values, as in {{'category': 'mass'}}, not {clipped(repr(where))}"
        )
    chosen = list(found)
    for name, wanted in where.items():
        if name not in ATTRIBUTES:
            raise VariantError(unknown("unknown attribute", name, ATTRIBUTES))
        values = _values(name, wanted)
        present = {getattr(episode.origin, name) for episode in found}
        missing = sorted(values - present, key=str)
        if missing and not (len(values) > 1 and values & present):
            near = suggestion(str(missing[0]), map(str, present))
            raise VariantError(
                f"no episode has the {name} {missing[0]!r}{near}; "
                f"valid: {listed([str(value) for value in sorted(present)], SHOWN_VALUES)}"
            )
        chosen = [episode for episode in chosen if getattr(episode.origin, name) in values]
    if not chosen:
        criteria = ", ".join(f"{name} {wanted!r}" for name, wanted in where.items())
        raise VariantError(f"no episode has all of {criteria}")
    return chosen


def _values(name: str, wanted: Any) -> set[Any]:
    """Return the values of one attribute in ``where``, which may be one value or several."""
    several = isinstance(wanted, Collection) and not isinstance(wanted, str)
    try:
        values = set(wanted) if several else {wanted}
    except TypeError:
        values = set()
    if not values:
        raise VariantError(f"where: {name} must be a value or a list of values, not {clipped(repr(wanted))}")
    return values


def portion_of(origins: Sequence[Origin], portion: tuple[float, float], seed: int) -> list[int]:
    """Return which episodes make up a share of each origin's episodes, in their order.

    A portion is the start and the end of the share of the episodes that ``seed`` shuffles. (0, 0.75) and
    (0.75, 1) are two disjoint shares that together are all.

    Raises:
        ArgumentError: when ``portion`` is not an interval within [0, 1], or the seed is not valid.
        DatasetError: when no episode falls into the portion.
    """
    whole_number(seed, "seed", least=0)
    try:
        low, high = portion
        valid = bool(0 <= low < high <= 1)
    except (TypeError, ValueError):
        valid = False
    if not valid:
        raise ArgumentError(
            f"portion must be two increasing numbers from 0 to 1, as in (0.0, 0.75), "
            f"not {clipped(repr(portion))}"
        )
    if (low, high) == (0, 1):
        return list(range(len(origins)))
    chosen: list[int] = []
    for order, drawn in shuffled(origins, seed):
        # Where each episode draws its variant, every variant has one episode. If all of them were rounded in
        # the same direction, one share would have everything and the other nothing.
        rounding = drawn if len(order) == 1 else 0.5
        chosen += order[int(low * len(order) + rounding) : int(high * len(order) + rounding)]
    if not chosen:
        raise DatasetError(f"no episode falls into the portion {portion} of {len(origins)}")
    return sorted(chosen)


def shuffled(origins: Sequence[Origin], seed: int) -> Iterator[tuple[list[int], float]]:
    """Yield, for each origin, the places of its episodes in a drawn order, and a number drawn from [0, 1)."""
    places: dict[Origin, list[int]] = {}
    for place, origin in enumerate(origins):
        places.setdefault(origin, []).append(place)
    for origin, members in places.items():
        digest = hashlib.sha256(f"{origin.variant} {origin.tier}".encode()).digest()
        rng = np.random.default_rng([seed, int.from_bytes(digest[:8], "little")])
        yield [members[i] for i in rng.permutation(len(members))], rng.random()
