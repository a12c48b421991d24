"""Arrays as ``torch.utils.data.Dataset``: one of transitions, one of windows.

Both answer a whole batch by one fancy index (``__getitems__``, which ``DataLoader`` prefers), so that a
batch costs one copy of each array; give the loader :func:`as_is` as its ``collate_fn``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from imujoco_minari.loading.load import Arrays
from imujoco_minari.loading.sampling import gather_windows, window_starts
from imujoco_minari.loading.transitions import Packed, gather_transitions

Batch = dict[str, torch.Tensor]


class TransitionDataset(Dataset[Batch]):
    """Steps, each a dict of the tensors of :class:`~imujoco_minari.loading.load.Transitions`.

    Args:
        data: the arrays, or what :func:`~imujoco_minari.loading.transitions.pack` made of them.
    """

    def __init__(self, data: Arrays | Packed) -> None:
        self.data = data

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, row: int) -> Batch:
        return {name: tensor[0] for name, tensor in self.__getitems__([row]).items()}

    def __getitems__(self, rows: Sequence[int]) -> Batch:
        """Return a batch of steps."""
        return _tensors(gather_transitions(self.data, np.asarray(rows)))


class WindowDataset(Dataset[Batch]):
    """Windows of ``length`` steps, as dicts of tensors: :class:`~imujoco_minari.loading.sampling.Windows`.

    Args:
        data: the arrays.
        length: steps of a window.
        padded: also windows that end with their episode before ``length`` steps, padded with zeros.
    """

    def __init__(self, data: Arrays, length: int, *, padded: bool = False) -> None:
        self.arrays, self.length = data, length
        self._starts = window_starts(data, length, padded=padded)

    def __len__(self) -> int:
        return len(self._starts)

    def __getitem__(self, window: int) -> Batch:
        return {name: tensor[0] for name, tensor in self.__getitems__([window]).items()}

    def __getitems__(self, windows: Sequence[int]) -> Batch:
        """Return a batch of windows."""
        return _tensors(gather_windows(self.arrays, self._starts[np.asarray(windows)], self.length))


def as_is(batch: Any) -> Any:
    """Return a batch that is one already: the ``collate_fn`` of a ``DataLoader`` over these datasets."""
    return batch


def _tensors(batch: Any) -> Batch:
    return {name: torch.from_numpy(array) for name, array in batch._asdict().items()}
