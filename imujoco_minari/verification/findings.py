"""What a check reports, and how values that may be anything are compared and shown."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
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


class Findings(list[Finding]):
    """What is wrong with a dataset; empty for a sound one.

    Attributes:
        exceptions: what cannot be checked of it, in words that follow "sound, but".
        replayable: whether its episodes are complete enough for a replay.
    """

    def __init__(
        self, findings: Iterable[Finding] = (), exceptions: Sequence[str] = (), *, replayable: bool = True
    ) -> None:
        super().__init__(findings)
        self.exceptions, self.replayable = tuple(exceptions), replayable

    def __repr__(self) -> str:
        if self:
            return f"<{len(self)} findings, first {clipped(self[0])}>"
        return f"<sound{', but ' if self.exceptions else ''}{clipped(', '.join(self.exceptions))}>"

    def clip(self) -> None:
        """Keep the first findings, and state that there may be more."""
        if len(self) >= MAX_FINDINGS:
            self[MAX_FINDINGS:] = [Finding("the check", f"stopped after {MAX_FINDINGS} findings")]


def differs(where: str, value: Any, valid: str) -> Finding:
    """Return the finding that a value is not valid; ``valid`` says what would be."""
    return Finding(where, f"is {shown(value)}, not {valid}")


def differing(
    place: str, stated: Mapping[str, Any], expected: Mapping[str, Any], reason: str = ""
) -> Iterator[Finding]:
    """Report the keys whose values are not as expected. A missing value counts as None.

    ``place`` is what the keys belong to, as in ``metadata.json/`` or ``episode_0@``. ``reason`` follows the
    expected value in the message.
    """
    for key, value in expected.items():
        if not same(stated.get(key), value):
            yield differs(f"{place}{key}", stated.get(key), shown(value) + reason)


def plain(value: Any) -> Any:
    """Return an HDF5 attribute's value as a Python scalar where it is one."""
    return value.item() if isinstance(value, np.generic) else value


def same(value: Any, expected: Any) -> bool:
    """Return whether a value, which may be anything, is the expected JSON value, type by type."""
    value, expected = plain(value), plain(expected)
    if type(value) is type(expected) and isinstance(value, str | int):
        return bool(value == expected)
    try:
        return json.dumps(value, sort_keys=True) == json.dumps(expected, sort_keys=True)
    except (TypeError, ValueError, RecursionError):
        return False


def shown(value: Any) -> str:
    """Return ``value`` as a message quotes it, however long it is."""
    return "missing" if value is None else clipped(repr(plain(value)))
