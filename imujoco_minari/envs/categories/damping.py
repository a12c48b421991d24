"""Damping: the torque of one joint against its velocity, per velocity."""

from imujoco_minari.envs.categories.interface import CategoryLaw, Edit, find_all


def _apply(edit: Edit) -> None:
    for joint in find_all(edit, "joint"):
        joint.damping = joint.damping * edit.factor


CATEGORY = CategoryLaw(
    "damping", "damping", "damping", "joint", _apply, frozenset({"dof_damping", "dof_dampingpoly"})
)
