"""Which variants and datasets a command works on. The filters mean the same in every command.

``--robot`` and ``--category`` choose variants of the catalogue, and ``--all`` chooses all 154 of them.
The base robots are not variants: ``--with-base`` adds those of the chosen variants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from imujoco_minari.cli.printing import counted
from imujoco_minari.errors import DatasetNotFoundError, VariantError
from imujoco_minari.storage import minari_root
from imujoco_minari.variants import BASE, EXPERT, Variant, catalogue


@dataclass(frozen=True)
class Filters:
    """The filters of a command.

    Attributes:
        robot: variants of this robot; None for any.
        category: variants of this category; None for any.
        everything: all variants of the catalogue.
        with_base: add the base robots of the chosen variants.
    """

    robot: str | None = None
    category: str | None = None
    everything: bool = False
    with_base: bool = False

    def __bool__(self) -> bool:
        """Whether they choose variants. ``--with-base`` alone does not."""
        return bool(self.robot or self.category or self.everything)

    @property
    def given(self) -> bool:
        """Whether any filter is given."""
        return bool(self) or self.with_base

    def check_no_names(self, names: Sequence[str] | None) -> None:
        """Check that a command does not have both names and filters.

        Raises:
            VariantError: if there are names and filters.
        """
        if names and self.given:
            raise VariantError(f"give ids or {self}, not both")

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
            raise VariantError(
                f"the catalogue lists no {self.category or ''} variants{of}; name one with any percent, "
                "as in hopper-gearinc_50_thighjoint"
            )
        if not self.with_base:
            return list(chosen)
        robots = groupby(chosen, key=lambda variant: variant.base)
        return [each for base, variants in robots for each in (base, *variants)]


def counted_variants(variants: Sequence[Variant]) -> str:
    """Return how many variants and bases there are, in words: ``37 variants and 1 base``."""
    bases = sum(variant.category == BASE for variant in variants)
    words = [counted(len(variants) - bases, "variant"), *([counted(bases, "base")] if bases else [])]
    return " and ".join(words)


def select(names: Sequence[str] | None, filters: Filters) -> list[Variant]:
    """Return the variants that a command names, or those that its filters choose from the catalogue.

    Raises:
        VariantError: if a name is no variant, or there are names and filters, or neither.
    """
    filters.check_no_names(names)
    if names:
        return list(dict.fromkeys(Variant.parse(name) for name in names))
    if not filters:
        raise VariantError("name a variant, or choose some with --robot, --category or --all")
    return filters.variants()


def select_datasets(
    ids: Sequence[str] | None, filters: Filters, tiers: Sequence[str] | None = None, *, published: bool = True
) -> list[str]:
    """Return the dataset ids that a command names, or those of the chosen variants and tiers.

    Args:
        ids: the ids that the command names.
        filters: its filters.
        tiers: its tiers; only the experts' data when there are none.
        published: leave out datasets that the Minari root does not hold.

    Raises:
        VariantError: if there are ids and filters, or neither.
        DatasetNotFoundError: if nothing is left.
    """
    filters.check_no_names(ids)
    if ids and tiers:
        raise VariantError("give dataset ids or --tier, not both")
    if ids:
        return list(dict.fromkeys(ids))
    if not filters:
        raise VariantError("give dataset ids, or choose some with --robot, --category or --all")
    tiers = list(dict.fromkeys(tiers or [EXPERT]))
    found = [variant.dataset_id(tier) for tier in tiers for variant in filters.variants()]
    if published:
        found = [dataset_id for dataset_id in found if minari_root.exists(dataset_id)]
    if not found:
        raise DatasetNotFoundError(
            f"no {' or '.join(tiers)} dataset of {filters} is in the Minari root: "
            f"make them with `{_publish_command(filters, tiers)}`"
        )
    return found


def not_published(
    missing: Sequence[str],
    chosen: Sequence[str],
    filters: Filters,
    tiers: Sequence[str] | None,
    other: str = "",
) -> DatasetNotFoundError:
    """Return the error for chosen datasets that are not published; ``other`` names another way."""
    return DatasetNotFoundError(
        f"{len(missing)} of {counted(len(chosen), 'dataset')} are not in the Minari root: "
        f"make them with `{_publish_command(filters, tiers or [EXPERT])}`{other}"
    )


def _publish_command(filters: Filters, tiers: Sequence[str]) -> str:
    return f"imujoco publish {filters}" + "".join(f" --tier {tier}" for tier in tiers if tiers != [EXPERT])
