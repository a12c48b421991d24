"""Compares the experts with the experts of their base robots: one line for each robot and category.

The share of an expert is its mean return divided by the mean return of its base's expert.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import fsum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from imujoco_minari.policies.experts import readable_record
from imujoco_minari.policies.rungs import has_even_ranks, has_medium, mean_return, share_of
from imujoco_minari.variants import BASE, CATEGORIES, ROBOTS, Variant, catalogue

# The share that an expert should reach.
BAR = 0.95
# Headings of a table of standings, for the fields of each.
COLUMNS = (
    "robot",
    "category",
    "policies",
    "of",
    "median",
    "min",
    f"below {BAR}",
    "medium",
    "ranked",
    "core-hours",
)


class Standing(NamedTuple):
    """The experts of one robot's category, or of its base.

    ``policies`` of ``of`` variants have an expert that was evaluated. ``median`` and ``minimum`` are of their
    shares, None without experts; ``below`` counts those below :data:`BAR`. ``medium`` and ``ranked`` count
    the experts whose rungs have the returns that these tiers need. ``hours`` are the core-hours of training.
    """

    robot: str
    category: str
    policies: int
    of: int
    median: float | None
    minimum: float | None
    below: int
    medium: int
    ranked: int
    hours: float

    def cells(self) -> list[str]:
        """Return the cells of the table's row, in the order of :data:`COLUMNS`."""
        shares = ("-" if share is None else f"{share:.2f}" for share in (self.median, self.minimum))
        robot, category, policies, of, _, _, *counts, hours = self
        return [str(cell) for cell in (robot, category, policies, of, *shares, *counts, f"{hours:.1f}")]


def standings(
    robots: Sequence[str] = ROBOTS,
    categories: Sequence[str] = (BASE, *CATEGORIES),
    folder: Path | None = None,
) -> list[Standing]:
    """Return the standing of each robot and category, of which ``base`` is one.

    A record that cannot be read is left out with a warning.
    """
    lines = []
    for robot in robots:
        base = readable_record(Variant(robot), folder)
        for category in categories:
            variants = [each for each in (Variant(robot), *catalogue(robot)) if each.category == category]
            if not variants:
                continue
            records = [readable_record(variant, folder) for variant in variants]
            # A folded expert that nobody has evaluated has no return.
            records = [record for record in records if "evaluation" in record]
            shares = [share_of(mean_return(record), base) for record in records] if base else []
            lines.append(
                Standing(
                    robot,
                    category,
                    len(records),
                    len(variants),
                    float(np.median(shares)) if shares else None,
                    min(shares, default=None),
                    sum(share < BAR for share in shares),
                    sum(map(has_medium, records)),
                    sum(map(has_even_ranks, records)),
                    fsum(map(seconds_trained, records)) / 3600,
                )
            )
    return lines


def share_of_base(record: Mapping[str, Any], folder: Path | None = None) -> float | None:
    """Return the share of the evaluated expert with this record; None when its base has no expert."""
    base = readable_record(Variant.parse(record["variant"]).base, folder)
    return share_of(mean_return(record), base) if base else None


def seconds_trained(record: Mapping[str, Any]) -> float:
    """Return the seconds that a policy was trained, together with the policies that it was improved from.

    A folded expert has no training of its own: 0.
    """
    before = record.get("before")
    return float(record.get("wall_seconds", 0)) + (seconds_trained(before) if before else 0.0)
