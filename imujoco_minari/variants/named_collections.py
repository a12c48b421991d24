"""The ids of collections that stand for whole sets: all listed variants of a robot, or of one category."""

from __future__ import annotations

from dataclasses import dataclass

from imujoco_minari.errors import VariantError
from imujoco_minari.variants.ids import EXPERT, Variant, catalogue, full_id, name_in
from imujoco_minari.variants.robots import known_robots, specification


@dataclass(frozen=True)
class NamedCollection:
    """The collection of all listed variants of a robot, or of one of its categories, in one tier.

    Attributes:
        robot: the robot.
        category: the category; None for all.
        tier: the tier of the data.

    Raises:
        VariantError: when there is no such robot or category, or the tier is malformed.

    Example:
        >>> NamedCollection("hopper", "mass", "random").dataset_id
        'imujoco/hopper-mass-random-v0'
    """

    robot: str
    category: str | None = None
    tier: str = EXPERT

    def __post_init__(self) -> None:
        if not self.sources:
            raise VariantError(f"the catalogue lists no {self.category} variants of {self.robot}")

    @property
    def dataset_id(self) -> str:
        """The id, ``imujoco/<robot>-<all or category>[-<tier>]-v0``."""
        return full_id(f"{self.robot}-{self.category or 'all'}", self.tier)

    @property
    def variants(self) -> tuple[Variant, ...]:
        """The variants, in the catalogue's order."""
        return catalogue(self.robot, self.category)

    @property
    def sources(self) -> list[str]:
        """The ids of the datasets that it combines."""
        return [variant.dataset_id(self.tier) for variant in self.variants]

    @classmethod
    def parse(cls, dataset_id: str) -> NamedCollection | None:
        """Return the collection that a dataset id names, or None when it names none."""
        robot, _, rest = name_in(dataset_id).partition("-")
        part, _, tier = rest.partition("-")
        if robot not in known_robots() or part not in ("all", *specification(robot).categories):
            return None
        try:
            collection = cls(robot, None if part == "all" else part, tier or EXPERT)
        except VariantError:
            return None
        return collection if collection.dataset_id == dataset_id else None
