"""Variant ids, the catalogue, the robots' specifications and the named splits.

A variant is a robot with one or several physical parameters changed. This package names variants and lists
them; it knows nothing of MuJoCo, Gymnasium or datasets.
"""

from imujoco_minari.variants.changes import MAX_PERCENT, Change
from imujoco_minari.variants.ids import (
    BASE,
    COMPOUND,
    EXPERT,
    NAMESPACE,
    Variant,
    bases,
    catalogue,
    parse_dataset_id,
)
from imujoco_minari.variants.pages import CATEGORIES, Listing, RobotSpecification, parse_specification
from imujoco_minari.variants.ranges import DISTRIBUTIONS, Ranges
from imujoco_minari.variants.robots import (
    ROBOTS,
    adopt_page,
    carried_page,
    forget_page,
    known_robots,
    specification,
)
from imujoco_minari.variants.splits import HeldOut, held_out, held_out_names

__all__ = [
    "BASE",
    "CATEGORIES",
    "COMPOUND",
    "DISTRIBUTIONS",
    "EXPERT",
    "MAX_PERCENT",
    "NAMESPACE",
    "ROBOTS",
    "Change",
    "HeldOut",
    "Listing",
    "Ranges",
    "RobotSpecification",
    "Variant",
    "adopt_page",
    "bases",
    "carried_page",
    "catalogue",
    "forget_page",
    "held_out",
    "held_out_names",
    "known_robots",
    "parse_dataset_id",
    "parse_specification",
    "specification",
]
