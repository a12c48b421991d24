"""The outcome of work on one dataset of a batch, which goes on after a failure."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from imujoco_minari.errors import ImujocoError
from imujoco_minari.short_repr import short_repr


@dataclass(frozen=True)
class DatasetOutcome:
    """The outcome of work on one dataset.

    Attributes:
        dataset_id: the dataset's id.
        path: folder of the dataset; None if the work failed.
        error: why it failed; empty on success.
        missing: whether it failed because something that was asked for does not exist.
    """

    dataset_id: str
    path: Path | None = None
    error: str = ""
    missing: bool = False

    __repr__ = short_repr

    @classmethod
    def failed(cls, dataset_id: str, error: ImujocoError, **fields: Any) -> Self:
        """Return the outcome of work that raised an error."""
        return cls(dataset_id, error=str(error), missing=error.missing, **fields)


@dataclass(frozen=True, repr=False)
class Published(DatasetOutcome):
    """The outcome of publishing one dataset.

    Attributes:
        created: whether this call made it; False if it existed already.
        episodes: number of episodes.
        steps: number of steps.
        return_mean: mean undiscounted return of the episodes.
        return_std: standard deviation of the returns.
        content_sha256: digest of the arrays.
        seconds: wall time.
    """

    created: bool = False
    episodes: int = 0
    steps: int = 0
    return_mean: float = float("nan")
    return_std: float = float("nan")
    content_sha256: str = field(default="", repr=False)
    seconds: float = 0.0


@dataclass(frozen=True, repr=False)
class Deleted(DatasetOutcome):
    """The outcome of deleting one dataset: ``path`` is its former folder, ``bytes`` the size of its files."""

    bytes: int = 0
