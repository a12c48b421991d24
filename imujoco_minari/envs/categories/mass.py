"""Mass: the mass and the inertia of one body. The shape stays."""

from imujoco_minari.envs.categories.interface import CategoryLaw, Edit, find_all


def _apply(edit: Edit) -> None:
    for body in find_all(edit, "limb"):
        body.mass *= edit.factor
        body.inertia = body.inertia * edit.factor


CATEGORY = CategoryLaw("mass", "mass", "mass", "limb", _apply, frozenset({"body_mass", "body_inertia"}))
