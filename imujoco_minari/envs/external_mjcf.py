"""MJCF from outside: checked, and rewritten for today's MuJoCo.

The archive's models are gym's of 2021. Those of Hopper and Walker2d have ``coordinate="global"``, which
MuJoCo dropped, so they are rewritten in local coordinates.

Each text is checked as :mod:`~imujoco_minari.envs.untrusted_mjcf` describes.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from imujoco_minari.envs import mjcf
from imujoco_minari.envs.untrusted_mjcf import check_bounds, check_compiled, check_text, measure, one_line
from imujoco_minari.errors import ModelError
from imujoco_minari.variants import Variant

_POSITIONED = ("geom", "joint", "site", "camera", "light", "inertial")
_TURNED = ("quat", "axisangle", "xyaxes", "zaxis", "euler")


def canonical_external_mjcf(text: str, robot: str, name: str) -> str:
    """Return the canonical text of a model from outside, in global or local coordinates.

    Raises:
        ModelError: when the text is unsafe, does not compile, or has other bodies, joints or actuators than
            ``robot``. The message calls the model ``name``.
    """
    root = check_text(text, name)
    _localise(root, name)
    # Today's MuJoCo always does both, and warns of the words.
    for compiler in root.iter("compiler"):
        compiler.attrib.pop("coordinate", None)
    for size in root.iter("size"):
        size.attrib.pop("nstack", None)
    local = ET.tostring(root, encoding="unicode")
    check_compiled(local, name)
    try:
        spec = mjcf.bake(local)
        spec.compile()
        canonical = str(spec.to_xml())
        model = mjcf.compile_mjcf(canonical)
    except (ValueError, KeyError) as error:
        raise ModelError(f"{name}: MuJoCo cannot compile the model: {one_line(error)}") from None
    _check_robot(model, robot, name)
    check_bounds(measure(model), canonical, name)
    return canonical


def _localise(root: ET.Element, name: str) -> None:
    """Rewrite global coordinates as local ones, in place."""
    coordinates = {compiler.get("coordinate", "local") for compiler in root.iter("compiler")}
    if "global" not in coordinates:
        return
    for default in root.iter("default"):
        if any({"pos", "fromto", *_TURNED} & set(element.attrib) for element in default.iter()):
            raise ModelError(f"{name}: defaults with positions in global coordinates are not supported")
    for world in root.iter("worldbody"):
        for body in world.findall("body"):
            _localise_body(body, (0.0, 0.0, 0.0), name)


def _localise_body(body: ET.Element, parent: Sequence[float], name: str) -> None:
    if "pos" not in body.attrib:
        raise ModelError(f"{name}: body {body.get('name')!r} has no pos, which global coordinates need")
    if any(key in body.attrib for key in _TURNED):
        raise ModelError(
            f"{name}: body {body.get('name')!r} is rotated, which is not supported in global coordinates"
        )
    origin = _numbers(body.attrib["pos"])
    body.set("pos", _text(np.subtract(origin, parent)))
    for element in body:
        if element.tag == "body":
            _localise_body(element, origin, name)
        elif "fromto" in element.attrib:
            element.set(
                "fromto", _text(np.subtract(_numbers(element.attrib["fromto"], 6), (*origin, *origin)))
            )
        elif element.tag in _POSITIONED:
            element.set("pos", _text(np.subtract(_numbers(element.get("pos", "")), origin)))


def _numbers(text: str, count: int = 3) -> tuple[float, ...]:
    """Read numbers as MuJoCo did when these files were written.

    It stopped at the first thing that is no number and left the rest zero: gym's ``0.13/2 0 0.1`` was
    (0.13, 0, 0), and Gymnasium's own rewriting of the file agrees.
    """
    numbers = []
    for word in text.split():
        match = re.match(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?", word)
        if match is None:
            break
        numbers.append(float(match[0]))
        if match.end() != len(word):
            break
    return tuple((numbers + [0.0] * count)[:count])


def _text(numbers: Any) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _check_robot(model: mujoco.MjModel, robot: str, name: str) -> None:
    """Raise a ModelError unless bodies, joints and actuators are the robot's, in its order."""
    expected = _parts(mjcf.compile_mjcf(mjcf.canonical_mjcf(Variant(robot))))
    for kind, names in _parts(model).items():
        if names != expected[kind]:
            raise ModelError(
                f"{name}: is no {robot}: its {kind} are {', '.join(names)[:200]}, "
                f"not {', '.join(expected[kind])}"
            )


def _parts(model: mujoco.MjModel) -> dict[str, list[str]]:
    joints = [model.joint(i).name for i in range(model.njnt)]
    targets = zip(model.actuator_trntype, model.actuator_trnid[:, 0], strict=True)
    return {
        "bodies": [model.body(i).name for i in range(model.nbody)],
        "joints": joints,
        "actuated joints": [
            joints[i] if kind == mujoco.mjtTrn.mjTRN_JOINT else "none" for kind, i in targets
        ],
    }
