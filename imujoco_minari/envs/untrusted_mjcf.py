"""MJCF texts from outside: what they may contain, and how large a model they may make.

A text may name no file, and no element that is not on a short list. A child process with limits on memory
and time compiles a text that passes, and reports sizes and solver settings. This process compiles the text
only if these are within bounds.
"""

from __future__ import annotations

import json
import re
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from operator import attrgetter
from pathlib import Path

import mujoco

from imujoco_minari.errors import JobError, ModelError
from imujoco_minari.limits import run_limited

# An HDF5 attribute holds at most 64 KiB; the longest model of the package's robots has 16 KB.
MAX_BYTES = 48 * 1024
MAX_DEPTH = 40

# The elements of the robots' models, as gym, Gymnasium and MuJoCo write them, and some that are as harmless.
_ELEMENTS = frozenset(
    (
        *("mujoco", "compiler", "size", "option", "flag", "statistic", "default"),
        *("visual", "map", "global", "quality", "headlight", "scale", "rgba"),
        *("asset", "texture", "material", "layer"),
        *("worldbody", "body", "inertial", "joint", "freejoint", "geom", "site", "camera", "light"),
        *("actuator", "motor", "general", "position", "velocity", "damper", "contact", "pair", "exclude"),
        *("tendon", "fixed", "custom", "numeric", "equality", "connect", "weld", "keyframe", "key"),
    )
)
_REFUSED = frozenset(("plugin", "content_type"))
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
WITHIN_BOUNDS: set[str] = set()
_MEASURE = "imujoco_minari.envs.untrusted_mjcf:measure_apart"


def check_mjcf(text: str, name: str) -> None:
    """Check that an MJCF text in local coordinates may be compiled, simulated and drawn in this process.

    Raises:
        ModelError: when the text is unsafe, does not compile, or the compiled model is out of bounds. The
            message calls the model ``name``.
    """
    check_text(text, name)
    check_compiled(text, name)


def measure_apart(path: str) -> bytes:
    """Return the bounded fields of the model in a file, or why it does not compile. A child runs this."""
    text = Path(path).read_text("utf-8")
    try:
        return json.dumps(measure(mujoco.MjModel.from_xml_string(text))).encode()
    except ValueError as error:
        return json.dumps(one_line(error)).encode()


def check_compiled(text: str, name: str) -> None:
    """Compile a text in a child process and check the model's fields, once for each text."""
    if text in WITHIN_BOUNDS:
        return
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
    check_bounds(fields, text, name)


def measure(model: mujoco.MjModel) -> dict[str, float]:
    """Return the bounded fields of a compiled model."""
    return {field: float(attrgetter(field)(model)) for field in _BOUNDS}


def check_bounds(fields: Mapping[str, float], text: str, name: str) -> None:
    """Note that the compiled model of a text is within the bounds; raise a ModelError if it is not."""
    for field, (low, high) in _BOUNDS.items():
        if not low <= fields[field] <= high:
            raise ModelError(
                f"{name}: {field} of the compiled model is {fields[field]:g}; valid: {low:g} to {high:g}"
            )
    WITHIN_BOUNDS.add(text)


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
        raise ModelError(f"{name}: not XML: {one_line(error)}") from None
    if root.tag != "mujoco":
        raise ModelError(f"{name}: no MJCF: the root is <{one_line(root.tag)[:40]}>, not <mujoco>")
    _check_element(root, name, 0)
    return root


def _check_element(element: ET.Element, name: str, depth: int) -> None:
    tag = str(element.tag)
    if tag not in _ELEMENTS:
        raise ModelError(
            f"{name}: <{one_line(tag)[:40]}> is refused; the models of the robots have no such element"
        )
    if depth > MAX_DEPTH:
        raise ModelError(f"{name}: elements are nested deeper than {MAX_DEPTH}")
    for key, value in element.attrib.items():
        reason = _refusal(key, value)
        if reason:
            raise ModelError(f'{name}: {key}="{one_line(value)[:60]}" in <{tag}> {reason}')
    for child in element:
        _check_element(child, name, depth + 1)


def _refusal(key: str, value: str) -> str:
    """Return why an attribute is refused; empty when it is not."""
    if "file" in key or (key.endswith("dir") and key != "dir") or key in _REFUSED:
        return "is refused"
    # MuJoCo only warns of it, and writes the warning to a file wherever it runs.
    return "is no number" if re.search(r"\b(?:nan|inf)", value, re.IGNORECASE) else ""


def one_line(text: object) -> str:
    """Return at most 200 characters of a text, on one line."""
    return " ".join(str(text).split())[:200]
