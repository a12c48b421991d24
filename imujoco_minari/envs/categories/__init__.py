"""The categories: each module edits one physical parameter of a model, behind one interface.

A module defines a :class:`~imujoco_minari.envs.categories.interface.CategoryLaw`. It says what the category
edits, and which fields of the compiled model it promises to change. The category leaves all others alone.
"""

from collections.abc import Mapping
from types import MappingProxyType

from imujoco_minari.envs.categories import (
    armature,
    damping,
    friction,
    gear,
    gravity,
    joint,
    length,
    mass,
    size,
)
from imujoco_minari.envs.categories.interface import CategoryLaw, Edit
from imujoco_minari.variants import CATEGORIES

__all__ = ["BY_NAME", "CategoryLaw", "Edit"]

_MODULES = (mass, joint, length, friction, gravity, gear, damping, armature, size)
_ALL = tuple(module.CATEGORY for module in _MODULES)
BY_NAME: Mapping[str, CategoryLaw] = MappingProxyType({category.name: category for category in _ALL})
assert tuple(BY_NAME) == CATEGORIES, "the ids and the models have the same categories"
