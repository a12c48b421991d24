"""How the experts stand beside their bases: each one's share of its base's return, and a line for many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.policies.experts import expert_record
from imujoco_minari.variants import BASE, CATEGORIES, ROBOTS, Variant, bases, catalogue

# The share of its base's return that an expert is to reach.
BAR = 0.95
# Of a table of standings; the first two are words.
COLUMNS = ("robot", "category", "policies", "of", "median", "min", f"below {BAR}", "core-hours")


@dataclass(frozen=True)
class Standing:
    """The experts of one robot's category.

    Attributes:
        robot: the robot.
        category: the category, ``base`` among them.
        policies: how many there are.
        of: how many the catalogue has variants.
        median: of return / base expert's return; None without policies.
        minimum: of the same.
        below: how many are below ``BAR``.
        hours: core-hours that they were trained, evaluations included.
    """

    robot: str
    category: str
    policies: int
    of: int
    median: float | None
    minimum: float | None
    below: int
    hours: float

    def cells(self) -> list[str]:
        """Return what stands under ``COLUMNS``."""
        shares = ("-" if share is None else f"{share:.2f}" for share in (self.median, self.minimum))
        counts = str(self.policies), str(self.of)
        return [self.robot, self.category, *counts, *shares, str(self.below), f"{self.hours:.1f}"]


def standings(
    robots: Sequence[str] = ROBOTS,
    categories: Sequence[str] = (BASE, *CATEGORIES),
    folder: Path | None = None,
) -> list[Standing]:
    """Return a line for each robot and category.

    Args:
        robots: of these.
        categories: of these.
        folder: see :func:`~imujoco_minari.policies.expert_record`.
    """
    lines = []
    for robot in robots:
        for category in categories:
            variants = (
                [v for v in bases() if v.robot == robot] if category == BASE else catalogue(robot, category)
            )
            records = [record for variant in variants if (record := expert_record(variant, folder))]
            shares = [share for record in records if (share := share_of_base(record, folder)) is not None]
            lines.append(
                Standing(
                    robot,
                    category,
                    len(records),
                    len(variants),
                    float(np.median(shares)) if shares else None,
                    min(shares, default=None),
                    sum(share < BAR for share in shares),
                    sum(map(seconds_trained, records)) / 3600,
                )
            )
    return lines


def share_of_base(record: Mapping[str, Any], folder: Path | None = None) -> float | None:
    """Return a record's return as a share of its base expert's; None where there is no such."""
    base = expert_record(Variant.parse(record["variant"]).base, folder)
    return float(record["evaluation"]["return_mean"] / base["evaluation"]["return_mean"]) if base else None


def seconds_trained(record: Mapping[str, Any]) -> float:
    """Return how long a record's policy was trained, and what it was improved from before."""
    before = record.get("before")
    return float(record["wall_seconds"]) + (seconds_trained(before) if before else 0.0)
