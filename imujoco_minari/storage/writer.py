"""Writes complete episodes to a Minari HDF5 file: arrays, attributes and digests in one pass.

The stock storage opens the file, converts lists and rewrites ``metadata.json`` at every episode. That takes
9 ms for an episode whose physics take 25 ms, and its chunked arrays are scattered over the file. This writer
keeps the file open and writes contiguous arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from gymnasium.envs.registration import EnvSpec
from h5py import h5a, h5d, h5g, h5s, h5t
from minari.data_collector import EpisodeBuffer
from minari.data_collector.callbacks import EpisodeMetadataCallback
from minari.dataset.minari_storage import MinariStorage

from imujoco_minari.storage import file_format
from imujoco_minari.storage.quiet_file import safe_point, writing

# Seed of an episode -> its attributes.
Attributes = Callable[[Any], Mapping[str, Any]]

_SCALAR = h5s.create(h5s.SCALAR)
_TEXT = h5py.string_dtype()
_TEXT_TYPE = h5t.py_create(_TEXT, logical=True)


class EpisodeWriter(ExitStack):
    """Writes episodes of plain arrays, without infos, to a new Minari storage, in the order of their numbers.

    The file is complete at the end of the ``with`` block. Its metadata state no totals yet.

    Args:
        folder: the new folder of the storage. Its parent must exist.
        spec: specification of the environment that the episodes are of.
        attributes: returns the attributes of the episode with a seed, in addition to Minari's own.
    """

    def __init__(self, folder: Path, spec: EnvSpec, attributes: Attributes = lambda seed: {}) -> None:
        super().__init__()
        storage = MinariStorage.new(folder, env_spec=spec)
        self.observation_space, self.action_space = storage.observation_space, storage.action_space
        self._path, self._attributes = file_format.main_file(folder), attributes
        self._file: h5py.File | None = None
        self._waiting: dict[int, EpisodeBuffer] = {}
        self._written = 0

    def add(self, episode: EpisodeBuffer) -> None:
        """Write an episode after those with smaller numbers. An episode without a number is the next."""
        if self._file is None:
            self._file = self.enter_context(writing(self._path))
        self._waiting[self._written if episode.id is None else episode.id] = episode
        while self._written in self._waiting:
            self._write_next(self._file, self._waiting.pop(self._written))
            self._written += 1

    def _write_next(self, file: h5py.File, episode: EpisodeBuffer) -> None:
        """Write the group of an episode: its arrays, its attributes and its digests.

        h5py's high-level interface takes four times as long to write something as small as an attribute.
        """
        safe_point()
        group = h5g.create(file.id, file_format.episode_name(self._written).encode())
        # Minari prints the keys of an episode's infos, and fails if there is no group.
        h5g.create(group, file_format.INFOS.encode())
        arrays = {key: np.ascontiguousarray(getattr(episode, key)) for key in file_format.ARRAYS}
        digests = {key: file_format.array_sha256(array) for key, array in arrays.items()}
        for key, array in arrays.items():
            kind, space = h5t.py_create(array.dtype, logical=True), h5s.create_simple(array.shape)
            dataset = h5d.create(group, key.encode(), kind, space)
            dataset.write(h5s.ALL, h5s.ALL, array)
            write_attribute(dataset, file_format.DIGEST, digests[key])
        attributes = {
            "id": self._written,
            "total_steps": len(arrays["rewards"]),
            **self._attributes(episode.seed),
            **({} if episode.seed is None else {"seed": episode.seed}),
            **EpisodeMetadataCallback()(arrays),
            file_format.DIGEST: file_format.episode_sha256(digests),
        }
        for key, value in attributes.items():
            write_attribute(group, key, value)


def write_attribute(owner: Any, name: str, value: Any) -> None:
    """Write a new attribute, a scalar, an array or a string, to a low-level group or dataset."""
    if isinstance(value, str):
        attribute = h5a.create(owner, name.encode(), _TEXT_TYPE, _SCALAR)
        attribute.write(np.array(value, dtype=_TEXT))
        return
    array = np.asarray(value)
    space = h5s.create_simple(array.shape) if array.ndim else _SCALAR
    h5a.create(owner, name.encode(), h5t.py_create(array.dtype, logical=True), space).write(array)


def read_text(owner: Any, name: str) -> str:
    """Read a string attribute of a low-level group or dataset."""
    text = np.empty((), dtype=_TEXT)
    h5a.open(owner, name.encode()).read(text)
    value = text[()]
    return value.decode() if isinstance(value, bytes) else str(value)
