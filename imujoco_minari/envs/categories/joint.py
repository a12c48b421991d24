"""Joint: both ends of the range of one joint."""

from imujoco_minari.envs.categories.interface import CategoryLaw, Edit, find_all


def _apply(edit: Edit) -> None:
    for joint in find_all(edit, "joint"):
        joint.range = joint.range * edit.factor


CATEGORY = CategoryLaw("joint", "range", "range of motion", "joint", _apply, frozenset({"jnt_range"}))
