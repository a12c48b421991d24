"""Armature: the inertia that the motor of one joint adds to it."""

from imujoco_minari.envs.categories.interface import CategoryLaw, Edit, find_all


def _apply(edit: Edit) -> None:
    for joint in find_all(edit, "joint"):
        joint.armature *= edit.factor


CATEGORY = CategoryLaw(
    "armature", "armature", "inertia of the motor", "joint", _apply, frozenset({"dof_armature"})
)
