"""The categories that multiply a number of a part of the model, and leave everything else."""

from collections.abc import Sequence

from imujoco_minari.envs.categories.interface import CategoryLaw, Edit, find_all


def _scaling(
    name: str, noun: str, quantity: str, part: str, attributes: Sequence[str], fields: Sequence[str]
) -> CategoryLaw:
    """Return the category that multiplies these attributes of a part, as MuJoCo's MjSpec names them."""

    def apply(edit: Edit) -> None:
        for found in find_all(edit, part):
            for attribute in attributes:
                setattr(found, attribute, getattr(found, attribute) * edit.factor)

    return CategoryLaw(name, noun, quantity, part, apply, frozenset(fields))


# The mass and the inertia of one limb. Its shape stays.
MASS = _scaling("mass", "mass", "mass", "limb", ["mass", "inertia"], ["body_mass", "body_inertia"])
# Both ends of the range of one joint.
JOINT = _scaling("joint", "range", "range of motion", "joint", ["range"], ["jnt_range"])
# The acceleration that acts on all bodies. Its direction stays.
GRAVITY = _scaling("gravity", "gravity", "gravity", "world", ["gravity"], ["opt.gravity"])
# The strength of one motor, which a page names by its joint. Actions keep their range.
GEAR = _scaling("gear", "strength", "strength of the motor", "motor", ["gear"], ["actuator_gear"])
# The torque of one joint against its velocity, per velocity.
DAMPING = _scaling("damping", "damping", "damping", "joint", ["damping"], ["dof_damping", "dof_dampingpoly"])
# The inertia that the motor of one joint adds to it.
ARMATURE = _scaling("armature", "armature", "inertia of the motor", "joint", ["armature"], ["dof_armature"])
