"""Which variants and datasets a command works on. The filters mean the same in every command.

``--robot`` and ``--category`` choose variants of the catalogue, and ``--all`` chooses all 154 of them.
The base robots are not variants: ``--with-base`` adds those of the chosen variants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from imujoco_minari.cli import options
from imujoco_minari.cli.printing import counted
from imujoco_minari.errors import DatasetNotFoundError, VariantError
from imujoco_minari.storage import minari_root
from imujoco_minari.variants import BASE, EXPERT, Variant, catalogue, known_robots, specification


@dataclass(frozen=True)
class Filters:
    """The filters of a command, each with the meaning that its help states."""

    robot: options.Robot = None
    category: options.Category = None
    everything: options.Everything = False
    with_base: options.WithBase = False

    def __bool__(self) -> bool:
        """Whether they choose variants. ``--with-base`` alone does not."""
        return bool(self.robot or self.category or self.everything)

    def check(self, names: Sequence[str] | None, request: str) -> None:
        """Raise a VariantError if a command has both names and filters, or neither."""
        if names and (self or self.with_base):
            raise VariantError(f"give ids or {self}, not both")
        if not names and not self:
            raise VariantError(f"{request}, or choose some with --robot, --category or --all")

    def __str__(self) -> str:
        words = ["--all"] if self.everything else []
        words += [f"--robot {self.robot}"] if self.robot else []
        words += [f"--category {self.category}"] if self.category else []
        return " ".join(words + ["--with-base"] * self.with_base)

    def variants(self) -> list[Variant]:
        """Return the variants that the filters choose. With ``with_base``, each robot's base comes first.

        Raises:
            VariantError: if there is no such robot or category.
        """
        chosen = catalogue(self.robot, self.category)
        if not chosen:
            of = f" of {self.robot}" if self.robot else ""
            robot, category = self.robot or "hopper", self.category or "mass"
            body = next(iter(specification(robot).categories[category].bodies))
            raise VariantError(
                f"the catalogue lists no {self.category or ''} variants{of}; name one with any percent, "
                f"as in {robot}-{category}dec_50_{body}"
            )
        if not self.with_base:
            return list(chosen)
        robots = groupby(chosen, key=lambda variant: variant.base)
        return [each for base, variants in robots for each in (base, *variants)]


@dataclass(frozen=True)
class VariantChoice(Filters):
    """The variants that a command names, or else those that its filters choose from the catalogue."""

    names: options.VariantIds = None

    def variants(self) -> list[Variant]:
        """Return the chosen variants.

        Raises:
            VariantError: if a name is no variant, or there are names and filters, or neither.
        """
        self.check(self.names, "name a variant")
        if robots := set(self.names or ()) & set(known_robots()):
            robot = min(robots)
            raise VariantError(
                f"{robot} is a robot: --robot {robot} chooses its variants, "
                f"and {robot}-base is the unchanged robot"
            )
        if self.names:
            return list(dict.fromkeys(Variant.parse(name) for name in self.names))
        return super().variants()


@dataclass(frozen=True)
class DatasetChoice(Filters):
    """The datasets that a command names, or else those of the chosen variants and tiers."""

    ids: options.MaybeDatasetIds = None
    tiers: options.Tiers = None

    def datasets(self, *, published: bool = True) -> list[str]:
        """Return the ids of the chosen datasets.

        Args:
            published: leave out the filters' datasets that the Minari root does not hold.

        Raises:
            VariantError: if there are ids and filters, or neither.
            DatasetNotFoundError: if nothing is left.
        """
        self.check(self.ids, "give dataset ids")
        if self.ids and self.tiers:
            raise VariantError("give dataset ids or --tier, not both")
        if self.ids:
            return list(dict.fromkeys(self.ids))
        tiers = list(dict.fromkeys(self.tiers or [EXPERT]))
        found = [variant.dataset_id(tier) for tier in tiers for variant in self.variants()]
        if published:
            found = [dataset_id for dataset_id in found if minari_root.exists(dataset_id)]
        if not found:
            raise DatasetNotFoundError(
                f"no {' or '.join(tiers)} dataset of {self} is in the Minari root: "
                f"make them with `{self._publish_command()}`"
            )
        return found

    def not_published(self, missing: int, chosen: int, other: str = "") -> DatasetNotFoundError:
        """Return the error for chosen datasets that are not published; ``other`` names another way."""
        return DatasetNotFoundError(
            f"{missing} of {counted(chosen, 'dataset')} are not in the Minari root: "
            f"make them with `{self._publish_command()}`{other}"
        )

    def _publish_command(self) -> str:
        tiers = [] if self.tiers in (None, [EXPERT]) else dict.fromkeys(self.tiers or [])
        return " ".join([f"imujoco publish {self}", *(f"--tier {tier}" for tier in tiers)])


def counted_variants(variants: Sequence[Variant]) -> str:
    """Return how many variants and bases there are, in words: ``37 variants and 1 base``."""
    bases = sum(variant.category == BASE for variant in variants)
    return counted(len(variants) - bases, "variant") + (f" and {counted(bases, 'base')}" if bases else "")
