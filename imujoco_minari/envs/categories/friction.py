"""Friction: the sliding friction of the contacts between feet and floor, and of no other contacts.

A contact takes the larger friction of its two geoms, so a smaller friction of the foot alone would change
little or nothing. An explicit contact pair overrides both. Its other parameters are those that MuJoCo derives
from the two geoms.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from imujoco_minari.envs.categories.interface import CategoryLaw, Edit, find, find_all


def _apply(edit: Edit) -> None:
    floor = find(edit.spec, "geom", "floor")
    for foot in find_all(edit, "geom"):
        slide, spin, roll = contact_parameter(foot, floor, "friction")
        slide *= edit.factor
        pair = edit.spec.add_pair(geomname1="floor", geomname2=foot.name)
        pair.condim = int(contact_parameter(foot, floor, "condim"))
        pair.friction = [slide, slide, spin, roll, roll]
        pair.solref = contact_parameter(foot, floor, "solref")
        pair.solimp = contact_parameter(foot, floor, "solimp")
        pair.margin = foot.margin + floor.margin
        pair.gap = foot.gap + floor.gap


def contact_parameter(foot: Any, floor: Any, name: str) -> Any:
    """Return a parameter of the contact of two geoms, of a spec or of a compiled model.

    It is that of the geom with the higher priority. Of two with one priority, it is the larger value, or for
    the solver's parameters the mean by the weights of the geoms.
    """
    if foot.priority != floor.priority:
        return getattr(max(foot, floor, key=lambda geom: geom.priority), name)
    if name in ("friction", "condim"):
        return np.maximum(getattr(foot, name), getattr(floor, name))
    share = foot.solmix / (foot.solmix + floor.solmix)
    return share * getattr(foot, name) + (1 - share) * getattr(floor, name)


FRICTION = CategoryLaw("friction", "friction", "friction on the floor", "geom", _apply, frozenset())
