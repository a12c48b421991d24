"""What a category is, and how it finds the parts of a model that a page names."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import mujoco

from imujoco_minari.errors import ModelError, unknown
from imujoco_minari.short_repr import short_repr
from imujoco_minari.variants import RobotSpecification


@dataclass(frozen=True)
class Edit:
    """One change, as a category applies it to a model.

    Attributes:
        spec: the model, with its compiled inertias written out. The category changes it in place.
        names: MJCF names of the parts to change.
        factor: the factor on the base value, ``1 + percent / 100``.
        page: the robot's page.
        base: the unchanged model, compiled. Categories take measures from it, and do not change it.
    """

    spec: mujoco.MjSpec = field(repr=False)
    names: tuple[str, ...]
    factor: float
    page: RobotSpecification = field(repr=False)
    base: mujoco.MjModel = field(repr=False)


@dataclass(frozen=True)
class CategoryLaw:
    """A physical parameter that a variant may change.

    Attributes:
        name: the word in ids.
        noun: the parameter in one word, for captions.
        quantity: the parameter in full.
        part: the kind of the model's parts that a page names for it: ``limb``, ``geom``, ``joint``,
            ``motor`` or ``world``.
        apply: edits a model. A factor of 1 leaves the compiled model the same to the bit.
        fields: names of the fields of the compiled model that it changes. All others stay, but those that
            MuJoCo derives from these.
        moves_limbs: whether the shape changes, so that the robot must be stood on the floor again.
    """

    name: str
    noun: str
    quantity: str
    part: str
    apply: Callable[[Edit], None] = field(repr=False)
    fields: frozenset[str]
    moves_limbs: bool = False

    __repr__ = short_repr


def find(spec: mujoco.MjSpec, part: str, name: str) -> Any:
    """Return the part of a model that a page names; raise a ModelError if the model has no such part.

    A ``limb`` is a body, named by itself or by its only geom; a ``motor`` is named by the joint that it
    moves; the ``world`` is the model's options.
    """
    if part == "limb":
        found, known = _limb(spec, name), _limb_names(spec)
    elif part == "motor":
        found = next((motor for motor in spec.actuators if motor.target == name), None)
        known = [motor.target for motor in spec.actuators]
    elif part == "world":
        found, known = spec.option if name == "world" else None, ["world"]
    else:
        found = getattr(spec, part)(name)
        known = [element.name for element in getattr(spec, f"{part}s")]
    if found is None:
        raise ModelError(unknown(f"the model has no {part}", name, filter(None, known)))
    return found


def find_all(edit: Edit, part: str) -> Iterator[Any]:
    """Yield the parts that an edit names."""
    return (find(edit.spec, part, name) for name in edit.names)


def _limb(spec: mujoco.MjSpec, name: str) -> mujoco.MjsBody | None:
    geom = spec.geom(name)
    if geom is None:
        return spec.body(name) if name != "world" else None
    body = geom.parent
    if body.name != name and len(body.geoms) != 1:
        raise ModelError(f"body {body.name!r} has several geoms, so {name!r} cannot change alone")
    return body


def _limb_names(spec: mujoco.MjSpec) -> list[str]:
    names = []
    for body in spec.bodies[1:]:
        names += [body.name] if len(body.geoms) != 1 else [body.geoms[0].name or body.name]
    return names
