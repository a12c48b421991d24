"""The categories: each edits one physical parameter of a model, behind one interface.

A :class:`~imujoco_minari.envs.categories.interface.CategoryLaw` says what a category edits, and which fields
of the compiled model it promises to change. It leaves all others alone.
"""

from collections.abc import Mapping
from types import MappingProxyType

from imujoco_minari.envs.categories.capsules import LENGTH, SIZE
from imujoco_minari.envs.categories.friction import FRICTION
from imujoco_minari.envs.categories.interface import CategoryLaw, Edit
from imujoco_minari.envs.categories.scaling import ARMATURE, DAMPING, GEAR, GRAVITY, JOINT, MASS
from imujoco_minari.variants import CATEGORIES

__all__ = ["BY_NAME", "CategoryLaw", "Edit"]

_ALL = (MASS, JOINT, LENGTH, FRICTION, GRAVITY, GEAR, DAMPING, ARMATURE, SIZE)
BY_NAME: Mapping[str, CategoryLaw] = MappingProxyType({category.name: category for category in _ALL})
assert tuple(BY_NAME) == CATEGORIES, "the ids and the models have the same categories"
