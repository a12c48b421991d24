"""An environment draws off-screen without a display and without ``MUJOCO_GL``."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from imujoco_minari.envs import gl

SCRIPT = """
import gymnasium, imujoco_minari
env = gymnasium.make("imujoco/hopper-massdec_25_leggeom-v0", render_mode="rgb_array", width=64, height=48)
env.reset(seed=0)
picture = env.render()
assert picture.shape == (48, 64, 3), picture.shape
assert picture.std() > 1
# PyTorch's default build loads Triton here.
import torch
torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have one OpenGL")
def test_an_environment_renders_without_a_display() -> None:
    if not any(gl._works(candidate) for candidate in gl.LIBRARIES):
        pytest.skip("no OpenGL here")
    variables = {
        key: value
        for key, value in os.environ.items()
        if key not in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY")
    }
    subprocess.run([sys.executable, "-c", SCRIPT], env=variables, check=True)
