"""Variant ids, the catalogue, the robots' specifications and the named splits.

A variant is a robot with one physical parameter changed. This package names variants and lists them; it
knows nothing of MuJoCo, Gymnasium or datasets.
"""

from imujoco_minari.variants.ids import (
    BASE,
    EXPERT,
    MAX_PERCENT,
    NAMESPACE,
    Variant,
    bases,
    catalogue,
    parse_dataset_id,
)
from imujoco_minari.variants.robots import (
    CATEGORIES,
    ROBOTS,
    Change,
    RobotSpecification,
    parse_specification,
    specification,
)
from imujoco_minari.variants.splits import HeldOut, held_out, held_out_names

__all__ = [
    "BASE",
    "CATEGORIES",
    "EXPERT",
    "MAX_PERCENT",
    "NAMESPACE",
    "ROBOTS",
    "Change",
    "HeldOut",
    "RobotSpecification",
    "Variant",
    "bases",
    "catalogue",
    "held_out",
    "held_out_names",
    "parse_dataset_id",
    "parse_specification",
    "specification",
]
