"""What a check finds in some of a dataset's episodes, or in all of them."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

from imujoco_minari.variants import Variant
from imujoco_minari.variants.original import variant_of
from imujoco_minari.verification.findings import Finding


@dataclass
class Content:
    """A summary of some episodes, which child processes make and the main process adds up.

    Attributes:
        findings: what is wrong with the episodes.
        readable: whether all of them could be read.
        sound: whether all of them are complete enough to be replayed.
        intact: whether no digest differs.
        linked: whether all of them are links to other files.
        episodes: number of episodes.
        steps: number of their steps.
        named: the attributes that name variant and tier, each combination once.
        runs: the number of the first episode of each run of episodes that have the same attributes of
            their policy (``rank``, ``rung``, ...), and these attributes.
        unreplayed: number of episodes that were imported without seeds.
        returns: return of each episode, as stated.
        digests: digest of each episode, as stored.
    """

    findings: list[Finding] = field(default_factory=list)
    readable: bool = True
    sound: bool = True
    intact: bool = True
    linked: bool = True
    episodes: int = 0
    steps: int = 0
    named: list[dict[str, str]] = field(default_factory=list)
    runs: list[tuple[int, dict[str, Any]]] = field(default_factory=list)
    unreplayed: int = 0
    returns: list[float] = field(default_factory=list)
    digests: list[str] = field(default_factory=list)

    @property
    def identities(self) -> list[tuple[Variant, str]]:
        """The variants and tiers of the episodes, each pair once."""
        return list(dict.fromkeys((variant_of(one), one["tier"]) for one in self.named))

    def add(self, parts: Iterable[Content]) -> Content:
        """Add the summaries of further episodes, in their order: flags must hold for all of them."""
        for part in parts:
            for name, more in vars(part).items():
                mine = getattr(self, name)
                setattr(self, name, mine and more if isinstance(mine, bool) else mine + more)
        return self

    def to_json(self) -> str:
        """Return the summary as text."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str | bytes) -> Content:
        """Return the summary of :meth:`to_json`.

        Raises:
            ValueError, TypeError, KeyError: when the text is not a summary.
        """
        values = json.loads(text)
        return cls(**values | {"findings": [Finding(**finding) for finding in values["findings"]]})
