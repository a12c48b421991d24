"""Length: the segment of one limb's capsule. Radius and density stay, so the mass changes with the length.

The point of the segment nearest to the limb's joint stays where it is: an end for most limbs, the ankle for
Hopper's foot, whose heel stands out behind it; the centre for the torso. Child bodies move with the end that
they are attached to.
"""

from imujoco_minari.envs.categories.capsules import SHAPE_FIELDS, reshape
from imujoco_minari.envs.categories.interface import CategoryLaw, Edit, find_all


def _apply(edit: Edit) -> None:
    # From mass to density and back would cost the last bit.
    if edit.factor != 1.0:
        for body in find_all(edit, "limb"):
            reshape(edit, body, length=edit.factor)


CATEGORY = CategoryLaw("length", "length", "length", "limb", _apply, SHAPE_FIELDS, moves_limbs=True)
