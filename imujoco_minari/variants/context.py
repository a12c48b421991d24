"""Contexts: the changes of a variant as a vector of numbers, in one order and one unit.

A *parameter* is a category and a body, as in ``mass/torsogeom``. Parameters are ordered by category, and
within a category as the robot's page lists the bodies, then the groups. A *context* has one number for each
parameter: the change relative to the base value, percent / 100. So -0.25 is a quarter less, and the base
robot is all zeros.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import VariantError, unknown
from imujoco_minari.variants.ids import Variant
from imujoco_minari.variants.robots import specification


def parameters(robot: str, *, groups: bool = False) -> tuple[str, ...]:
    """Return the names of all parameters of a robot, in the order of contexts.

    Args:
        robot: the robot.
        groups: in each category, add the groups of bodies.

    Raises:
        VariantError: if there is no such robot.

    Example:
        >>> parameters("hopper")[:2]
        ('mass/torsogeom', 'mass/thighgeom')
    """
    return tuple(
        f"{category}/{body}"
        for category, listing in specification(robot).categories.items()
        for body in (*listing.bodies, *(listing.groups if groups else ()))
    )


def changed_parameters(variants: Iterable[Variant]) -> tuple[str, ...]:
    """Return the parameters that at least one variant of a robot changes, in the order of contexts."""
    variants = list(variants)
    changed = {name for variant in variants for name in percents(variant)}
    listed = (
        [name for name in parameters(variants[0].robot, groups=True) if name in changed] if variants else []
    )
    # Variants of the original archive may change bodies that the robot's page does not list.
    return (*listed, *sorted(changed - set(listed)))


def percents(variant: Variant) -> dict[str, float]:
    """Return parameter -> percent for what a variant changes; empty for the base robot."""
    return {f"{change.category}/{change.body}": change.percent for change in variant.changes}


def context(variant: Variant, names: Sequence[str]) -> NDArray[np.float64]:
    """Return the context of a variant, read-only.

    Args:
        variant: the variant.
        names: the parameters of the entries, in order.

    Returns:
        The change of each parameter relative to the base value, percent / 100; shape ``(len(names),)``.

    Raises:
        VariantError: if the variant changes a parameter that is not among ``names``.

    Example:
        >>> context(Variant.parse("hopper-massdec_25_leggeom"), ["mass/torsogeom", "mass/leggeom"])
        array([ 0.  , -0.25])
    """
    changed = percents(variant)
    for name in changed:
        if name not in names:
            raise VariantError(
                f"{variant} changes {name}, which is not a parameter of this context; "
                f"it has {', '.join(names) or 'none'}"
            )
    vector = np.array([changed.get(name, 0.0) for name in names], dtype=np.float64) / 100
    vector.flags.writeable = False
    return vector


def check_parameters(robot: str, names: Iterable[str]) -> tuple[str, ...]:
    """Return parameters of a robot, each once, in the order of contexts.

    Raises:
        VariantError: if the robot has no such parameter, or if a name stands twice.
    """
    names, known = list(names), parameters(robot, groups=True)
    for name in names:
        if name not in known:
            raise VariantError(unknown(f"{robot} has no parameter", name, known))
        if names.count(name) > 1:
            raise VariantError(f"parameter {name!r} stands twice")
    return tuple(name for name in known if name in names)
