"""MJCF from outside: checked, and rewritten for today's MuJoCo.

The archive's models are gym's of 2021. Those of Hopper and Walker2d have ``coordinate="global"``, which
MuJoCo dropped, so they are rewritten in local coordinates.

A text may name no file, and no element that the robots do not use. What passes is compiled by a child process
with limits on memory and time, which reports sizes and solver settings. Only if these lie within bounds does
this process compile the text.
"""

from __future__ import annotations

import json
import re
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from imujoco_minari.envs import mjcf
from imujoco_minari.errors import JobError, ModelError
from imujoco_minari.limits import run_limited
from imujoco_minari.variants import Variant

# An HDF5 attribute holds at most 64 KiB; the longest model of the three robots has 6 KB.
MAX_BYTES = 48 * 1024
MAX_DEPTH = 40

# The elements of the robots' models, as gym, Gymnasium and MuJoCo write them.
_ELEMENTS = frozenset(
    (
        *("mujoco", "compiler", "size", "option", "flag", "statistic", "default"),
        *("visual", "map", "global", "quality", "headlight", "scale", "rgba"),
        *("asset", "texture", "material", "layer"),
        *("worldbody", "body", "inertial", "joint", "freejoint", "geom", "site", "camera", "light"),
        *("actuator", "motor", "general", "contact", "pair", "exclude"),
    )
)
_REFUSED = frozenset(("plugin", "content_type"))
_POSITIONED = ("geom", "joint", "site", "camera", "light", "inertial")
_TURNED = ("quat", "axisangle", "xyaxes", "zaxis", "euler")

# Address space (bytes) and processor time (s) to compile a model. The robots' take 20 MB and 0.01 s.
MAX_COMPILE_BYTES, MAX_COMPILE_SECONDS = 2**30, 10
# Fields of a compiled model and their bounds. The robots' models have 0.5 MB (nbuffer), nearly all of it
# textures, 14 MB of working memory (narena), 9 geoms, and MuJoCo's default of 100 solver iterations.
_BOUNDS: dict[str, tuple[float, float]] = {
    "nbuffer": (0, 2**26),
    "narena": (0, 2**26),
    "ntexdata": (0, 2**24),
    **dict.fromkeys(("nbody", "njnt", "nv", "nu", "ngeom", "nsite", "npair", "ncam", "nlight"), (0, 100)),
    "opt.timestep": (1e-4, 0.1),
    **dict.fromkeys(("opt.iterations", "opt.ls_iterations", "opt.noslip_iterations"), (0, 1000)),
    **dict.fromkeys(("opt.ccd_iterations", "opt.sdf_iterations", "opt.sdf_initpoints"), (0, 1000)),
    **dict.fromkeys(("vis.global_.offwidth", "vis.global_.offheight"), (0, 4096)),
    "vis.quality.shadowsize": (0, 8192),
    **dict.fromkeys(("vis.quality.offsamples", "vis.quality.numquads"), (0, 100)),
    **dict.fromkeys(("vis.quality.numslices", "vis.quality.numstacks"), (0, 100)),
}
# Texts that compiled within the bounds. Environments of one text are made often, and a child takes 0.6 s.
_WITHIN_BOUNDS: set[str] = set()
_MEASURE = "imujoco_minari.envs.external_mjcf:measure_apart"


def canonical_foreign_mjcf(text: str, robot: str, name: str) -> str:
    """Return the canonical text of a model of ``robot`` that came from outside.

    Args:
        text: MJCF in global or local coordinates.
        robot: the robot. The model must have its bodies, joints and actuators, in their order.
        name: what to call the model in messages.

    Raises:
        ModelError: when the text is unsafe, does not compile, or is not a model of the robot.
    """
    root = check_text(text, name)
    _localise(root, name)
    # Both are what every MuJoCo of today does anyway, and it warns of the words.
    for compiler in root.iter("compiler"):
        compiler.attrib.pop("coordinate", None)
    for size in root.iter("size"):
        size.attrib.pop("nstack", None)
    local = ET.tostring(root, encoding="unicode")
    _check_compiled(local, name)
    try:
        spec = mjcf.bake(local)
        spec.compile()
        canonical = str(spec.to_xml())
        model = mjcf.compile_mjcf(canonical)
    except (ValueError, KeyError) as error:
        raise ModelError(f"{name}: MuJoCo cannot compile the model: {_line(error)}") from None
    _check_robot(model, robot, name)
    _check_bounds(_measure(model), name)
    _WITHIN_BOUNDS.add(canonical)
    return canonical


def check_mjcf(text: str, name: str) -> None:
    """Check that an MJCF text may be compiled, simulated and drawn in this process.

    Args:
        text: MJCF in local coordinates.
        name: what to call the model in messages.

    Raises:
        ModelError: when the text is unsafe, does not compile, or the compiled model is out of bounds.
    """
    if text not in _WITHIN_BOUNDS:
        check_text(text, name)
        _check_compiled(text, name)
        _WITHIN_BOUNDS.add(text)


def measure_apart(path: str) -> bytes:
    """Return the bounded fields of the model in a file, or why it does not compile: what a child runs."""
    text = Path(path).read_text("utf-8")
    try:
        return json.dumps(_measure(mujoco.MjModel.from_xml_string(text))).encode()
    except ValueError as error:
        return json.dumps(_line(error)).encode()


def _check_compiled(text: str, name: str) -> None:
    """Compile a text in a child process and check the model's fields."""
    with tempfile.NamedTemporaryFile("w", encoding="utf-8", suffix=".xml") as file:
        file.write(text)
        file.flush()
        try:
            result = run_limited(_MEASURE, file.name, memory=MAX_COMPILE_BYTES, seconds=MAX_COMPILE_SECONDS)
        except JobError as error:
            raise ModelError(f"{name}: compiling the model {error}") from None
    fields = json.loads(result)
    if isinstance(fields, str):
        raise ModelError(f"{name}: MuJoCo cannot compile the model: {fields}")
    _check_bounds(fields, name)


def _measure(model: mujoco.MjModel) -> dict[str, float]:
    return {field: float(attrgetter(field)(model)) for field in _BOUNDS}


def _check_bounds(fields: Mapping[str, float], name: str) -> None:
    for field, (low, high) in _BOUNDS.items():
        if not low <= fields[field] <= high:
            raise ModelError(
                f"{name}: {field} of the compiled model is {fields[field]:g}; valid: {low:g} to {high:g}"
            )


def check_text(text: str, name: str) -> ET.Element:
    """Return the root of an MJCF text that loads no files.

    Raises:
        ModelError: when it is too large, is not MJCF, names a file, or has elements that no robot uses.
    """
    size = len(text.encode("utf-8", "replace"))
    if size > MAX_BYTES:
        raise ModelError(f"{name}: the model has {size} bytes; the limit is {MAX_BYTES}")
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
            f"{name}: <{_line(tag)[:40]}> is refused; the models of the robots have no such element"
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


def _check_robot(model: mujoco.MjModel, robot: str, name: str) -> None:
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


def _names(model: mujoco.MjModel, kind: str, count: int) -> list[str]:
    return [str(getattr(model, kind)(i).name) for i in range(count)]


def _actuated(model: mujoco.MjModel) -> list[str]:
    joint = mujoco.mjtTrn.mjTRN_JOINT
    return [
        str(model.joint(int(model.actuator_trnid[i][0])).name)
        if model.actuator_trntype[i] == joint
        else "none"
        for i in range(model.nu)
    ]


def _line(text: object) -> str:
    return " ".join(str(text).split())[:200]
