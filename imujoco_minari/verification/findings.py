"""What a check reports, and how values that may be anything are compared and shown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imujoco_minari.errors import clipped

MAX_FINDINGS = 100


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong: where (an HDF5 path or a metadata key) and what."""

    where: str
    what: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}"


@dataclass(frozen=True)
class Checked:
    """What is wrong with a dataset but for its replay.

    Attributes:
        findings: what is wrong.
        replayable: whether its episodes are whole enough for a replay.
        exceptions: what cannot be checked.
    """

    findings: list[Finding]
    replayable: bool
    exceptions: Sequence[str] = ()


class Findings(list[Finding]):
    """What is wrong with a dataset; empty for a sound one.

    Attributes:
        exceptions: what cannot be checked of it, in words that follow "sound, but".
    """

    def __init__(self, findings: Iterable[Finding] = (), exceptions: Sequence[str] = ()) -> None:
        super().__init__(findings)
        self.exceptions = tuple(exceptions)


def plain(value: Any) -> Any:
    """Return an HDF5 attribute's value as a Python scalar where it is one."""
    return value.item() if isinstance(value, np.generic) else value


def same(value: Any, expected: Any) -> bool:
    """Return whether a value, which may be anything, is ``expected``, a scalar or None."""
    value = plain(value)
    if expected is None or value is None:
        return value is expected
    if isinstance(value, bool) != isinstance(expected, bool):
        return False
    return isinstance(value, str | int | float) and bool(value == expected)


def shown(value: Any) -> str:
    """Return ``value`` as a message quotes it, however long it is."""
    return clipped(repr(plain(value)))
