"""Reads episodes of a Minari HDF5 file into existing arrays.

An episode is five small arrays, and h5py's objects around them take most of the time of a load. So this
module uses h5py's low-level interface, which takes a third of the time and makes no copy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import DatasetError
from imujoco_minari.storage.containment import LinkedFiles, check_array, check_links

Array = NDArray[Any]

_hdf5_type = cache(partial(h5py.h5t.py_create, logical=True))


class EpisodeFile(LinkedFiles):
    """A ``main_data.hdf5`` that is open for reading. Links within the Minari root are followed.

    Args:
        path: path of the file.
        name: the dataset id that error messages show.

    Raises:
        DatasetError: if the file cannot be opened.
    """

    def __init__(self, path: Path, name: str) -> None:
        self.name = name
        # Most episodes are used twice, for their length and for their arrays.
        self._groups: dict[int, h5py.h5g.GroupID] = {}
        try:
            # An array has few chunks, but the default cache makes a table of 521 slots for each array.
            super().__init__(path.absolute(), rdcc_nslots=31)
        except OSError as error:
            raise DatasetError(f"{name}: {path} cannot be read: {error}") from None

    @property
    def attributes(self) -> Mapping[str, Any]:
        """The attributes of the file."""
        return dict(self.file.attrs)

    def numbers(self) -> range:
        """Return the numbers of all episodes of the file."""
        return range(len(self.file))

    def episode_attributes(self, episode: int, names: Sequence[str]) -> dict[str, Any]:
        """Return the attributes among ``names`` that an episode has."""
        attributes = h5py.AttributeManager(h5py.Group(self._open_group(episode)))
        return {name: attributes[name] for name in names if name in attributes}

    def layout(self, episode: int, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """Return the shape and the dtype of one array of an episode; raise a DatasetError if it has none."""
        stored = self._open_array(self._open_group(episode), name, episode)
        return stored.shape, stored.dtype

    def length(self, episode: int) -> int:
        """Return the number of steps of an episode."""
        shape, _ = self.layout(episode, "rewards")
        if not shape:
            raise DatasetError(f"{self.name}: episode {episode}: rewards are not an array")
        return int(shape[0])

    def read(self, episode: int, targets: Mapping[str, Array]) -> None:
        """Read arrays of an episode into existing arrays.

        Args:
            episode: number of the episode.
            targets: maps the name of each array to a C-contiguous array of the stored shape, which is filled.

        Raises:
            DatasetError: if an array is missing, has another shape, or cannot be converted to the dtype.
        """
        group = self._open_group(episode)
        for name, out in targets.items():
            stored = self._open_array(group, name, episode)
            if stored.shape != out.shape:
                raise DatasetError(
                    f"{self.name}: episode {episode}: {name} have shape {stored.shape}, not {out.shape}"
                )
            try:
                stored.read(h5py.h5s.ALL, h5py.h5s.ALL, out, _hdf5_type(out.dtype))
            except (OSError, TypeError) as error:
                raise DatasetError(
                    f"{self.name}: episode {episode}: {name} cannot be read as {out.dtype}: {error}"
                ) from None

    def _open_group(self, episode: int) -> h5py.h5g.GroupID:
        """Return an episode's group, following a link."""
        if episode in self._groups:
            return self._groups[episode]
        try:
            # If HDF5 followed the link, it would open and close the other file for every episode.
            file, name = self.find(episode)
        except KeyError:
            raise DatasetError(f"{self.name} has no episode {episode}") from None
        except OSError as error:
            raise DatasetError(
                f"{self.name}: the file of episode {episode} cannot be read: {error}"
            ) from None
        try:
            group = h5py.h5g.open(file.id, name)
        except (KeyError, ValueError):
            raise DatasetError(f"{self.name}: episode {episode} is not a group of {file.filename}") from None
        check_links(group, f"{self.name}: episode {episode}: ")
        self._groups[episode] = group
        return group

    def _open_array(self, group: h5py.h5g.GroupID, name: str, episode: int) -> h5py.h5d.DatasetID:
        try:
            array = h5py.h5d.open(group, name.encode())
        except (KeyError, TypeError, ValueError):
            raise DatasetError(
                f"{self.name}: episode {episode} has no array {name}; "
                "valid: datasets whose observations and actions are arrays"
            ) from None
        check_array(array, f"{self.name}: episode {episode}: {name}")
        return array
