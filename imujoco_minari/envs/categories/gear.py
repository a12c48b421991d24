"""Gear: the strength of one motor, which a page names by its joint. Actions keep their range."""

from imujoco_minari.envs.categories.interface import CategoryLaw, Edit, find_all


def _apply(edit: Edit) -> None:
    for motor in find_all(edit, "motor"):
        motor.gear = motor.gear * edit.factor


CATEGORY = CategoryLaw(
    "gear", "strength", "strength of the motor", "motor", _apply, frozenset({"actuator_gear"})
)
