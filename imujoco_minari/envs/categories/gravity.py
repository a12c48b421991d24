"""Gravity: the acceleration that acts on all bodies. Its direction stays."""

from imujoco_minari.envs.categories.interface import CategoryLaw, Edit, find_all


def _apply(edit: Edit) -> None:
    for option in find_all(edit, "world"):
        option.gravity = option.gravity * edit.factor


CATEGORY = CategoryLaw("gravity", "gravity", "gravity", "world", _apply, frozenset({"opt.gravity"}))
