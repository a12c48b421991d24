"""What a dataset's HDF5 file holds beyond stock Minari, and the digests of its arrays.

Every array carries its own SHA-256; a dataset's ``content_sha256`` is the digest of those, in the
order of the episodes. So a changed bit is pinned to an array, and combining reads no array twice.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from imujoco_minari.variants import Variant

MAIN_FILE = "main_data.hdf5"
ARRAYS = ("observations", "actions", "rewards", "terminations", "truncations")
DIGEST = "sha256"
# False on imported episodes: they have no seed that would replay them.
REPLAYABLE = "replayable"


def attributes(variant: Variant, tier: str) -> dict[str, Any]:
    """Return the attributes that the root and every episode group of a dataset carry."""
    return {
        "variant": str(variant),
        "robot": variant.robot,
        "category": variant.category,
        "body": variant.body,
        "percent": variant.percent,
        "tier": tier,
    }


def array_sha256(array: Any) -> str:
    """Return the digest of an array: its dtype, its shape and its bytes in C order."""
    array = np.ascontiguousarray(array)
    digest = hashlib.sha256(f"{array.dtype.str}{array.shape}".encode())
    digest.update(array.data)
    return digest.hexdigest()


def arrays(group: h5py.Group, prefix: str = "") -> Iterator[tuple[str, h5py.Dataset]]:
    """Yield name and dataset of every array below an episode group, sorted by name."""
    for name in sorted(group):
        item = group[name]
        if isinstance(item, h5py.Group):
            yield from arrays(item, f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}", item


def seal_episode(group: h5py.Group) -> None:
    """Store with every array of an episode group its digest."""
    for _, array in arrays(group):
        array.attrs[DIGEST] = array_sha256(array[()])


def content_sha256(file: h5py.File, episodes: int) -> str:
    """Return the digest of a dataset: of the stored digests of its arrays, episode by episode.

    Raises:
        KeyError: when an episode is missing or an array was not sealed.
    """
    digest = hashlib.sha256()
    for episode in range(episodes):
        for name, array in arrays(file[f"episode_{episode}"]):
            digest.update(f"{episode}/{name} {array.attrs[DIGEST]}\n".encode())
    return digest.hexdigest()


def main_file(data_path: Path | str) -> Path:
    """Return the HDF5 file of a Minari dataset's ``data`` folder."""
    return Path(data_path) / MAIN_FILE
