"""MJCF from outside, made safe and made loadable by today's MuJoCo.

The archive's models are gym's of 2021: Hopper's and Walker2d's have ``coordinate="global"``, which
MuJoCo dropped, so they are rewritten in local coordinates here. A model may name no file, and nothing
of a kind that the three robots do not use; a text that does is refused before MuJoCo sees it.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from imujoco_minari.envs import mjcf
from imujoco_minari.errors import ModelError
from imujoco_minari.variants import Variant

# An HDF5 attribute holds at most 64 KiB; the longest model of the three robots has 6 KB.
MAX_BYTES = 48 * 1024
MAX_DEPTH = 40

# What the three robots' models consist of, in gym, Gymnasium and MuJoCo's own writing, and no more.
_ELEMENTS = frozenset(
    (
        *("mujoco", "compiler", "size", "option", "flag", "statistic", "default"),
        *("visual", "map", "global", "quality", "headlight", "scale", "rgba"),
        *("asset", "texture", "material", "layer"),
        *("worldbody", "body", "inertial", "joint", "freejoint", "geom", "site", "camera", "light"),
        *("actuator", "motor", "general", "contact", "pair", "exclude"),
    )
)
_BOUNDS = {"width": 4096, "height": 4096, "nstack": 10**7, "njmax": 10**5, "nconmax": 10**5}
_MAX_NUMBER = 10_000
_REFUSED = frozenset(("plugin", "content_type", "memory", "nkey", "count"))
_POSITIONED = ("geom", "joint", "site", "camera", "light", "inertial")
_TURNED = ("quat", "axisangle", "xyaxes", "zaxis", "euler")


def canonical_foreign_mjcf(text: str, robot: str, name: str) -> str:
    """Return the canonical text of a model of ``robot`` that came from outside.

    Args:
        text: MJCF in global or local coordinates.
        robot: whose bodies, joints and actuators it must have, in their order.
        name: what to call the model in messages.

    Raises:
        ModelError: when the text is unsafe, does not compile, or is no model of the robot.
    """
    root = check_text(text, name)
    _localise(root, name)
    # Both are what every MuJoCo of today does anyway, and it warns of the words.
    for compiler in root.iter("compiler"):
        compiler.attrib.pop("coordinate", None)
    for size in root.iter("size"):
        size.attrib.pop("nstack", None)
    try:
        spec = mjcf.bake(ET.tostring(root, encoding="unicode"))
        spec.compile()
        canonical = str(spec.to_xml())
        model = mjcf.compile_mjcf(canonical)
    except (ValueError, KeyError) as error:
        raise ModelError(f"{name}: MuJoCo cannot compile the model: {_line(error)}") from None
    _check_robot(model, robot, name)
    return canonical


def check_text(text: str, name: str) -> ET.Element:
    """Return the root of an MJCF text that is safe to compile.

    Raises:
        ModelError: when it is too large, is no MJCF, or holds what could load files or fill the memory.
    """
    if len(text.encode()) > MAX_BYTES:
        raise ModelError(f"{name}: the model has {len(text.encode())} bytes; the limit is {MAX_BYTES}")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ModelError(f"{name}: a model with a DOCTYPE or entities is refused")
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise ModelError(f"{name}: not XML: {_line(error)}") from None
    if root.tag != "mujoco":
        raise ModelError(f"{name}: no MJCF: the root is <{_line(root.tag)[:40]}>, not <mujoco>")
    _check_element(root, name, 0)
    return root


def _check_element(element: ET.Element, name: str, depth: int) -> None:
    tag = str(element.tag)
    if tag not in _ELEMENTS:
        raise ModelError(
            f"{name}: <{_line(tag)[:40]}> is refused; a model of these robots has no such element"
        )
    if depth > MAX_DEPTH:
        raise ModelError(f"{name}: elements are nested deeper than {MAX_DEPTH}")
    for key, value in element.attrib.items():
        reason = _refusal(key, value)
        if reason:
            raise ModelError(f'{name}: {key}="{_line(value)[:60]}" in <{tag}> {reason}')
    for child in element:
        _check_element(child, name, depth + 1)


def _refusal(key: str, value: str) -> str:
    """Return why an attribute is refused; empty when it is not."""
    if "file" in key or (key.endswith("dir") and key != "dir") or key in _REFUSED:
        return "is refused"
    whole = re.fullmatch(r"\s*([0-9]+)\s*", value, re.ASCII)
    if whole and (len(whole[1]) > 9 or int(whole[1]) > _BOUNDS.get(key, _MAX_NUMBER)):
        return "is too large"
    # MuJoCo only warns of it, and writes the warning to a file wherever it runs.
    return "is no number" if re.search(r"\b(?:nan|inf)", value, re.IGNORECASE) else ""


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


def _check_robot(model: Any, robot: str, name: str) -> None:
    """Raise a ModelError unless bodies, joints and actuators are the robot's, in its order."""
    base = mjcf.compile_mjcf(mjcf.canonical_mjcf(Variant(robot, "base", 0, "")))
    for kind, theirs, ours in (
        ("bodies", _names(model, "body", model.nbody), _names(base, "body", base.nbody)),
        ("joints", _names(model, "joint", model.njnt), _names(base, "joint", base.njnt)),
        ("actuated joints", _actuated(model), _actuated(base)),
    ):
        if theirs != ours:
            raise ModelError(
                f"{name}: is no {robot}: its {kind} are {', '.join(theirs)[:200]}, not {', '.join(ours)}"
            )


def _names(model: Any, kind: str, count: int) -> list[str]:
    return [str(getattr(model, kind)(i).name) for i in range(count)]


def _actuated(model: Any) -> list[str]:
    joint = mujoco.mjtTrn.mjTRN_JOINT
    return [
        str(model.joint(int(model.actuator_trnid[i][0])).name)
        if model.actuator_trntype[i] == joint
        else "none"
        for i in range(model.nu)
    ]


def _line(text: object) -> str:
    return " ".join(str(text).split())[:200]
