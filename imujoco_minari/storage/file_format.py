"""The attributes that a dataset's HDF5 file has in addition to Minari's, and the digests of its arrays.

Every array has its SHA-256, and every episode the digest of its arrays' digests. A dataset's
``content_sha256`` is the digest of the episodes' digests, in order. So a changed bit is traced to an array,
and combining reads one attribute per episode and no array.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from imujoco_minari.variants import Ranges, Variant
from imujoco_minari.variants.context import percents

MAIN_FILE = "main_data.hdf5"
ARRAYS = ("observations", "actions", "rewards", "terminations", "truncations")
# An empty group of each episode. Our episodes have no infos.
INFOS = "infos"
DIGEST = "sha256"
FILE_DIGEST, METADATA_DIGEST = "file_sha256", "metadata_sha256"
# Metadata key of a linked collection, which has no arrays of its own: for each source, in order, the number
# of its episodes and their digest.
LINKED = "linked"
# False on imported episodes that have no seed and so cannot be replayed.
REPLAYABLE = "replayable"

# The attributes that identify an episode. A collection carries those that all its episodes share.
IDENTITY = ("variant", "robot", "category", "body", "percent", "tier")
# The attributes of a dataset whose episodes draw their variants from ranges.
RANGES = ("ranges", "distribution")


def attributes(variant: Variant | Ranges, tier: str) -> dict[str, Any]:
    """Return the attributes of a dataset's file. If they name one variant, every episode has them too.

    A variant with several changes has ``changes`` too: a JSON object, parameter -> percent.
    """
    if isinstance(variant, Ranges):
        return {
            "robot": variant.robot,
            "tier": tier,
            "ranges": json.dumps(variant.ranges),
            "distribution": variant.distribution,
        }
    several = {"changes": json.dumps(percents(variant))} if len(variant.changes) > 1 else {}
    return {
        "variant": str(variant),
        "robot": variant.robot,
        "category": variant.category,
        "body": variant.body,
        "percent": variant.percent,
        "tier": tier,
        **several,
    }


def stated_ranges(metadata: Mapping[str, Any]) -> Ranges:
    """Return the ranges that the metadata of a dataset state.

    Raises:
        KeyError: if they state none.
        ImujocoError, ValueError, TypeError, AttributeError: if they are not valid.
    """
    robot, distribution = str(metadata.get("robot")), str(metadata.get("distribution"))
    return _parsed_ranges(robot, metadata["ranges"], distribution)


@lru_cache(maxsize=4)
def _parsed_ranges(robot: str, ranges: str, distribution: str) -> Ranges:
    # A check of a dataset compares every episode with the ranges.
    return Ranges(robot, json.loads(ranges), distribution)


def episode_name(number: int) -> str:
    """Return the name of an episode's group."""
    return f"episode_{number}"


def array_sha256(array: Any) -> str:
    """Return the digest of an array's dtype, shape and bytes in C order."""
    array = np.ascontiguousarray(array)
    digest = hashlib.sha256(f"{array.dtype.str}{array.shape}".encode())
    digest.update(array.data)
    return digest.hexdigest()


def arrays(group: h5py.Group, prefix: str = "") -> Iterator[tuple[str, h5py.Dataset]]:
    """Yield the path and the HDF5 dataset of every array in an episode group, sorted by name."""
    for name in sorted(group):
        item = group[name]
        if isinstance(item, h5py.Group):
            yield from arrays(item, f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}", item


def episode_sha256(digests: Mapping[str, str]) -> str:
    """Return the digest of an episode, given the digest of each array by name."""
    return hashlib.sha256(
        "".join(f"{name} {digests[name]}\n" for name in sorted(digests)).encode("utf-8", "surrogateescape")
    ).hexdigest()


def array_digests(group: h5py.Group) -> dict[str, str]:
    """Return the digest of every array of an episode group, by its path."""
    return {name: array_sha256(array[()]) for name, array in arrays(group)}


def seal_episode(group: h5py.Group) -> None:
    """Store the digest of every array of an episode group, and the digest of these digests."""
    digests = array_digests(group)
    for name, digest in digests.items():
        group[name].attrs[DIGEST] = digest
    group.attrs[DIGEST] = episode_sha256(digests)


def stated_digest(metadata: Mapping[str, Any]) -> Any:
    """Return the digest of a dataset's own or linked episodes as metadata states it, or None."""
    return metadata.get("content_sha256") or metadata.get(LINKED)


def collection_digest(content: Sequence[Any], *, link: bool) -> dict[str, Any]:
    """Return the metadata entry that states the digest of a collection's episodes.

    Args:
        content: the digest of each episode, or of each source of a linked collection as under ``LINKED``.
        link: whether it is a linked collection.
    """
    return {LINKED: content} if link else {"content_sha256": dataset_sha256(content)}


def content_sha256(file: h5py.File, episodes: int) -> str:
    """Return the digest of a dataset from the stored digests of its episodes, in order.

    Raises:
        KeyError: if an episode or its digest is missing.
    """
    return dataset_sha256(str(file[episode_name(number)].attrs[DIGEST]) for number in range(episodes))


def dataset_sha256(digests: Iterable[str]) -> str:
    """Return the digest of a dataset from its episodes' digests, in order."""
    return hashlib.sha256("".join(f"{digest}\n" for digest in digests).encode()).hexdigest()


def return_statistics(returns: Sequence[float]) -> dict[str, float]:
    """Return the mean and the standard deviation of episodes' returns, under their metadata keys.

    The sums are exact, so every processor gets the same bits. Returns that are too large to add give NaN.
    """
    try:
        mean = math.fsum(returns) / len(returns)
        variance = math.fsum((value - mean) ** 2 for value in returns) / len(returns)
    except (OverflowError, ValueError):
        mean = variance = math.nan
    return {"return_mean": mean, "return_std": math.sqrt(variance)}


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def metadata_sha256(metadata: Mapping[str, Any]) -> str:
    """Return the digest of metadata without its own digest, independent of order and whitespace."""
    covered = {key: value for key, value in metadata.items() if key != METADATA_DIGEST}
    return hashlib.sha256(json.dumps(covered, sort_keys=True).encode()).hexdigest()


def main_file(data_path: Path | str) -> Path:
    """Return the HDF5 file of a Minari dataset's ``data`` folder."""
    return Path(data_path) / MAIN_FILE
