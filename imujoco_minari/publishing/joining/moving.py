"""What changes in a file's bytes when they begin at another address."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.publishing.joining.records import ADDRESS, Positions


@dataclass(frozen=True)
class Changes:
    """Which bytes change, in order, and into what."""

    at: Positions
    values: NDArray[np.uint8]

    @classmethod
    def of(cls, fields: Positions, values: Positions) -> Changes:
        """Return the changes that give these fields of eight bytes these values."""
        order = np.argsort(fields)
        at = fields[order, None] + np.arange(ADDRESS.itemsize)
        return cls(at.ravel(), values[order].astype(ADDRESS).view(np.uint8))

    def make(self, block: memoryview, begin: int) -> None:
        """Make those changes that are in a block of the file, which begins at ``begin``."""
        first, last = np.searchsorted(self.at, (begin, begin + len(block)))
        np.frombuffer(block, np.uint8)[self.at[first:last] - begin] = self.values[first:last]
