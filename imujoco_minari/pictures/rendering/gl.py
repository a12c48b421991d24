"""Which OpenGL draws off-screen: EGL, else OSMesa, found by trying.

MuJoCo reads ``MUJOCO_GL`` when it is imported, which may long have happened, and PyOpenGL settles on
one platform a process. So a candidate is tried in a process of its own, and the context is then made
from MuJoCo's own module for it, whatever was imported before.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from functools import cache
from importlib import import_module
from typing import Any

from imujoco_minari.errors import RenderingError

# In order of preference, with the shared library that must load before a trial is worth its second.
LIBRARIES = {"egl": "libEGL.so.1", "osmesa": "libOSMesa.so.8"}
PACKAGES = {"egl": "libegl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}

_TRIAL = """
import os, sys
from importlib import import_module
context = import_module("mujoco." + sys.argv[1]).GLContext(16, 16)
context.make_current()
print("made", flush=True)
os._exit(0)
"""
_TRIAL_SECONDS = 60


@cache
def backend() -> str:
    """Return ``egl``, ``osmesa``, or ``native`` for what MuJoCo uses by itself on other systems.

    ``MUJOCO_GL`` and ``PYOPENGL_PLATFORM``, where the user has set them, decide. The choice is written
    to ``MUJOCO_GL``, so that an environment that renders by itself makes the same one.

    Raises:
        RenderingError: when none works, with the system packages that bring one.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower()
    if sys.platform != "linux" or (asked and asked not in LIBRARIES):
        return "native"
    candidates = [asked] if asked else _candidates()
    for candidate in candidates:
        if _works(candidate):
            os.environ["MUJOCO_GL"] = candidate
            return candidate
    raise RenderingError(
        f"no OpenGL to draw off-screen with: tried {' and '.join(candidates)}. Install Mesa's; on Debian and "
        + "Ubuntu: "
        + ", or ".join(f"`apt-get install {PACKAGES[candidate]}`" for candidate in candidates)
    )


def new_context(width: int, height: int) -> Any:
    """Make an OpenGL context that draws off-screen, and make it the current one.

    Raises:
        RenderingError: when no context can be made.
    """
    name = backend()
    try:
        module = import_module("mujoco.gl_context" if name == "native" else f"mujoco.{name}")
        context = module.GLContext(width, height)
        context.make_current()
    except Exception as error:  # PyOpenGL and MuJoCo raise whatever a missing driver makes them stumble on
        raise RenderingError(f"{name} cannot make an OpenGL context of {width}x{height}: {error}") from None
    return context


def _candidates() -> list[str]:
    """Return the platforms that this process can still take: PyOpenGL takes one, once."""
    taken = os.environ.get("PYOPENGL_PLATFORM", "").lower()
    return [taken] if taken in LIBRARIES else list(LIBRARIES)


def _works(candidate: str) -> bool:
    """Return whether a process of its own can make a context: a broken driver may take the process down."""
    try:
        ctypes.CDLL(LIBRARIES[candidate])
    except OSError:
        return False
    environment = {**os.environ, "MUJOCO_GL": candidate, "PYOPENGL_PLATFORM": candidate}
    try:
        trial = subprocess.run(
            [sys.executable, "-c", _TRIAL, candidate],
            env=environment,
            capture_output=True,
            text=True,
            timeout=_TRIAL_SECONDS,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return trial.stdout.strip().endswith("made")
