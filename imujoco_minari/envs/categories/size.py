"""Size: the thickness of one limb, which is the radius of its capsule.

The length of the capsule's segment and the density stay, so the mass changes with the thickness. The ends of
the segment stay where they are, and so do all other limbs.
"""

from imujoco_minari.envs.categories.capsules import SHAPE_FIELDS, reshape
from imujoco_minari.envs.categories.interface import CategoryLaw, Edit, find_all


def _apply(edit: Edit) -> None:
    # From mass to density and back would cost the last bit.
    if edit.factor != 1.0:
        for body in find_all(edit, "limb"):
            reshape(edit, body, radius=edit.factor)


CATEGORY = CategoryLaw("size", "thickness", "thickness", "limb", _apply, SHAPE_FIELDS, moves_limbs=True)
