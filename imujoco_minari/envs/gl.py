"""Choice of the OpenGL platform for off-screen rendering: EGL, or else OSMesa.

MuJoCo reads ``MUJOCO_GL`` once, when it is imported, and PyOpenGL uses one platform per process. So a
candidate is tried in a child process, and the context is made by MuJoCo's module for that candidate.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from contextlib import suppress
from functools import cache
from importlib import import_module
from typing import Any

from imujoco_minari.errors import RenderingError

# In order of preference, with its shared library. A trial takes a second and is skipped without the library.
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
    """Return ``egl``, ``osmesa``, or ``native`` for MuJoCo's own choice on other systems.

    ``MUJOCO_GL`` and ``PYOPENGL_PLATFORM`` decide if the user has set them. The choice is written to
    ``MUJOCO_GL``, so environments that render make the same choice.

    Raises:
        RenderingError: if none works. The message names the system packages to install.
    """
    # Mesa loads LLVM. Triton, in PyTorch's default build, crashes the process if it is loaded after that.
    with suppress(ImportError):
        import_module("triton")
    asked = os.environ.get("MUJOCO_GL", "").lower()
    if sys.platform != "linux" or (asked and asked not in LIBRARIES):
        return "native"
    # PyOpenGL chooses one platform per process.
    taken = asked or os.environ.get("PYOPENGL_PLATFORM", "").lower()
    candidates = [taken] if taken in LIBRARIES else list(LIBRARIES)
    for candidate in candidates:
        if _works(candidate):
            os.environ["MUJOCO_GL"] = candidate
            return candidate
    raise RenderingError(
        f"no OpenGL for off-screen rendering: tried {' and '.join(candidates)}. Install Mesa; on Debian and "
        + "Ubuntu: "
        + ", or ".join(f"`apt-get install {PACKAGES[candidate]}`" for candidate in candidates)
    )


def new_context(width: int, height: int) -> Any:
    """Make an off-screen OpenGL context for pictures of this size (pixels), and make it current."""
    name = backend()
    try:
        module = import_module("mujoco.gl_context" if name == "native" else f"mujoco.{name}")
        context = module.GLContext(width, height)
        context.make_current()
    except Exception as error:  # a missing driver causes many kinds of errors in PyOpenGL and MuJoCo
        raise RenderingError(f"{name} cannot make an OpenGL context of {width}x{height}: {error}") from None
    return context


def _works(candidate: str) -> bool:
    """Return whether a child process can make a context. A broken driver may crash the process."""
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
