"""The drawn model of a variant: the canonical model with the changed limb in a colour.

Only colours, light, floor and sky are added. Bodies, joints and geoms stay as in the canonical model. The
colours are Okabe and Ito's, which colour-blind people can tell apart.
"""

from __future__ import annotations

import mujoco
import numpy as np

from imujoco_minari.envs.categories import BY_NAME
from imujoco_minari.envs.mjcf import model_text
from imujoco_minari.errors import RenderingError
from imujoco_minari.pictures.rendering.framing import FIELD_OF_VIEW
from imujoco_minari.variants import Variant, specification

Colour = tuple[float, float, float]

COLOURS: dict[str, Colour] = {
    "mass": (0.835, 0.369, 0.0),
    "joint": (0.0, 0.447, 0.698),
    "length": (0.0, 0.620, 0.451),
    "friction": (0.800, 0.475, 0.655),
    "gear": (0.902, 0.624, 0.0),
    "damping": (0.337, 0.706, 0.914),
    "armature": (0.200, 0.133, 0.533),
    "size": (0.941, 0.894, 0.259),
}
NEAR: Colour = (0.70, 0.72, 0.75)
# A far leg is darker, because nothing else distinguishes it from the near one.
FAR: Colour = (0.46, 0.49, 0.54)
TILE = 1.0
# The kinds of parts that are drawn at a joint.
_AT_JOINTS = ("joint", "motor")


def scene_model(
    variant: Variant, mjcf: str | None = None, *, width: int, height: int, fine: bool = True
) -> mujoco.MjModel:
    """Return the model that is drawn for ``variant``, in pictures of at most ``width`` x ``height`` pixels.

    ``mjcf`` is the text of its model, for a variant of the original archive. ``fine`` means smooth edges and
    sharp shadows, at twice the time.

    Raises:
        RenderingError: if the model has no floor, as a variant of the archive may.
    """
    spec = mujoco.MjSpec.from_string(model_text(variant, mjcf))
    # Gymnasium's arms stand on planes of other names.
    planes = (geom for geom in spec.worldbody.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE)
    floor = spec.geom("floor") or next(planes, None)
    if floor is None:
        raise RenderingError(f"{variant} cannot be drawn: its model has no floor, a geom that is a plane")
    _replace_surroundings(spec, floor, fine)
    spec.visual.global_.fovy = FIELD_OF_VIEW
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    for geom in spec.geoms:
        if geom != floor:
            geom.material = ""
            geom.rgba = [*(FAR if "left" in geom.name else NEAR), 1.0]
    # The mark of a joint also tints the limb, so it comes before the colours of limbs.
    for change in sorted(variant.changes, key=lambda each: BY_NAME[each.category].part not in _AT_JOINTS):
        part = BY_NAME[change.category].part
        for name in specification(variant.robot).categories[change.category].names(change.body):
            if part in _AT_JOINTS:
                _mark_joint(spec.joint(name), COLOURS[change.category])
            elif part != "world":
                _tint(spec, part, name, COLOURS[change.category])
    return spec.compile()


def _tint(spec: mujoco.MjSpec, part: str, name: str, colour: Colour) -> None:
    """Colour a geom, or all geoms of a limb that is named by its body."""
    geom = spec.geom(name)
    body = spec.body(name) if part == "limb" and geom is None else None
    for each in body.geoms if body is not None else filter(None, [geom]):
        each.rgba = [*colour, 1.0]


def _mark_joint(joint: mujoco.MjsJoint, colour: Colour) -> None:
    """Add a disc around a joint and tint the limb that it moves."""
    body = joint.parent
    radius = body.geoms[0].size[0]
    for geom in body.geoms:
        geom.rgba = [*(0.55 * np.array(colour) + 0.45 * np.array(NEAR)), 1.0]
    ends = [*(joint.pos - 1.5 * radius * joint.axis), *(joint.pos + 1.5 * radius * joint.axis)]
    body.add_site(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        fromto=ends,
        size=[1.45 * radius, 0.0, 0.0],
        rgba=[*colour, 1.0],
        group=0,
    )


def _replace_surroundings(spec: mujoco.MjSpec, floor: mujoco.MjsGeom, fine: bool) -> None:
    """Replace floor, sky and light by those that all three robots share."""
    for element in (*spec.textures, *spec.materials, *spec.lights):
        if element.name != "floor":
            spec.delete(element)
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.80, 0.88, 0.95],
        rgb2=[0.97, 0.98, 0.99],
        width=64,
        height=64,
    )
    spec.add_texture(
        name="tiles",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.84, 0.86, 0.88],
        rgb2=[0.93, 0.94, 0.95],
        width=256,
        height=256,
    )
    tiles = spec.add_material(name="tiles", texuniform=True, texrepeat=[0.5 / TILE, 0.5 / TILE])
    tiles.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    tiles.specular, tiles.shininess = 0.0, 0.0
    floor.material, floor.rgba = "tiles", [1.0, 1.0, 1.0, 1.0]
    # Extents of zero draw an infinite floor. A cheetah runs far beyond the 40 m of its own floor.
    floor.size = [0.0, 0.0, 0.05]
    spec.bodies[1].add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM,
        pos=[0.6, -1.2, 4.0],
        dir=[-0.15, 0.3, -1.0],
        diffuse=[0.45, 0.45, 0.45],
        specular=[0.1, 0.1, 0.1],
        castshadow=True,
    )
    visual = spec.visual
    visual.headlight.ambient, visual.headlight.diffuse = [0.45] * 3, [0.30] * 3
    visual.headlight.specular = [0.05] * 3
    visual.rgba.haze = [0.93, 0.95, 0.97, 1.0]
    visual.quality.shadowsize = 2048 if fine else 512
    visual.quality.offsamples = 8 if fine else 4
    visual.map.znear, visual.map.zfar = 0.02, 40.0
