"""Arrays as ``torch.utils.data.Dataset``: one dataset of transitions, one of windows.

Both gather a whole batch with one index (``__getitems__``, which ``DataLoader`` prefers), so that a batch
costs one copy of each array. Pass :func:`as_is` to the loader as its ``collate_fn``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from imujoco_minari.loading import Arrays
from imujoco_minari.loading.batches import gather_transitions, gather_windows, window_starts
from imujoco_minari.loading.episode_arrays import check_arrays

Batch = dict[str, torch.Tensor]


class TransitionDataset(Dataset[Batch]):
    """The N steps of ``data``. An item is a dict of the tensors of one step.

    The keys are the fields of :class:`~imujoco_minari.loading.TransitionBatch`.

    Args:
        data: the arrays.

    Example:
        >>> loader = DataLoader(TransitionDataset(data), batch_size=256, collate_fn=as_is)  # doctest: +SKIP
    """

    def __init__(self, data: Arrays) -> None:
        check_arrays(data)
        self.data = data

    def __repr__(self) -> str:
        return f"TransitionDataset({self.data!r})"

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, row: int) -> Batch:
        return {name: tensor[0] for name, tensor in self.__getitems__([row]).items()}

    def __getitems__(self, rows: Sequence[int]) -> Batch:
        """Return a batch of steps: tensors (B, ...)."""
        return _tensors(gather_transitions(self.data, np.asarray(rows)))


class WindowDataset(Dataset[Batch]):
    """Windows of ``length`` steps of one episode. An item is a dict of the tensors of one window.

    The keys are the fields of :class:`~imujoco_minari.loading.Windows`.

    Args:
        data: the arrays.
        length: steps of a window.
        padded: include windows that the end of their episode cuts short, padded with zeros.

    Raises:
        DatasetError: when no episode has ``length`` steps.
    """

    def __init__(self, data: Arrays, length: int, *, padded: bool = False) -> None:
        self.data, self.length = data, length
        self._starts = window_starts(data, length, padded=padded)

    def __repr__(self) -> str:
        return f"WindowDataset({len(self)} windows of {self.length} steps, {self.data!r})"

    def __len__(self) -> int:
        return len(self._starts)

    def __getitem__(self, window: int) -> Batch:
        return {name: tensor[0] for name, tensor in self.__getitems__([window]).items()}

    def __getitems__(self, windows: Sequence[int]) -> Batch:
        """Return a batch of windows: tensors (B, length, ...)."""
        return _tensors(gather_windows(self.data, self._starts[np.asarray(windows)], self.length))


def as_is(batch: Any) -> Any:
    """Return the batch unchanged: the ``collate_fn`` of a ``DataLoader`` over these datasets."""
    return batch


def _tensors(batch: Any) -> Batch:
    return {name: torch.from_numpy(array) for name, array in batch._asdict().items()}
