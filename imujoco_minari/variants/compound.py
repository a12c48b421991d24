"""Variants with several changes, as in ``hopper-massinc_50_torsogeom-frictiondec_50_feet``."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from imujoco_minari.errors import VariantError
from imujoco_minari.variants.context import check_parameters, percents
from imujoco_minari.variants.ids import BASE, Variant

COMPOUND = "compound"


@dataclass(frozen=True, order=True)
class CompoundVariant(Variant):
    """One robot with several parameters changed; :func:`compound` makes it.

    Its category is ``compound``, its percent 0, and its body empty.
    """

    single: tuple[Variant, ...]

    def __post_init__(self) -> None:
        """Do not check category and body: the single changes are checked."""

    def __reduce__(self) -> tuple[Callable[..., Variant], tuple[object, ...]]:
        make, values = super().__reduce__()
        return make, (*values, self.single)

    def __str__(self) -> str:
        return "-".join((self.robot, *(str(change).partition("-")[2] for change in self.single)))

    @property
    def changes(self) -> tuple[Variant, ...]:
        """The changes of single parameters, in the order of contexts."""
        return self.single

    @property
    def mjcf_names(self) -> tuple[str, ...]:
        """Names of the MJCF elements that are changed, each once."""
        return tuple(dict.fromkeys(name for change in self.single for name in change.mjcf_names))


def compound(changes: Iterable[Variant]) -> Variant:
    """Return the variant of one robot with all the given changes.

    Args:
        changes: variants with one change each, of different parameters. Their order has no effect.

    Raises:
        VariantError: if they are of several robots, one is not a single change, or a parameter is changed
            twice.

    Example:
        >>> names = ["hopper-frictiondec_50_feet", "hopper-massinc_50_torsogeom"]
        >>> str(compound(Variant.parse(name) for name in names))
        'hopper-massinc_50_torsogeom-frictiondec_50_feet'
    """
    single = list(changes)
    robots = sorted({change.robot for change in single})
    if len(robots) != 1:
        raise VariantError(f"a variant has one robot, not {', '.join(robots) or 'none'}")
    for change in single:
        if change.category in (BASE, COMPOUND):
            raise VariantError(f"{change} is not the change of one parameter")
    if len(single) == 1:
        return single[0]
    named = [(name, change) for change in single for name in percents(change)]
    order = check_parameters(robots[0], [name for name, _ in named])
    ordered = sorted(named, key=lambda pair: order.index(pair[0]))
    return CompoundVariant(robots[0], COMPOUND, 0, "", tuple(change for _, change in ordered))
