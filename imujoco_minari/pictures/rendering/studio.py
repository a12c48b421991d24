"""The off-screen renderer: it draws positions of a model, seen by a camera."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from PIL import Image

from imujoco_minari.envs.gl import new_context
from imujoco_minari.envs.mjcf import model_text
from imujoco_minari.pictures.rendering.framing import AZIMUTH, ELEVATION, Camera
from imujoco_minari.pictures.rendering.scene import scene_model
from imujoco_minari.variants import Variant, bases


class Studio:
    """Draws variants in pictures of one size. It is a context manager.

    All variants share one OpenGL context and one set of textures, which are made for the first picture.

    Args:
        width: width of a picture, in pixels.
        height: height of a picture, in pixels.
        fine: draw smooth edges and sharp shadows, which takes twice the time.
    """

    def __init__(self, width: int, height: int, *, fine: bool = True) -> None:
        self.width, self.height, self._fine = width, height, fine
        self._models: dict[tuple[Variant, str], mujoco.MjModel] = {}
        self._stack = ExitStack()

    def __repr__(self) -> str:
        return f"Studio({self.width}x{self.height})"

    def __enter__(self) -> Studio:
        return self

    def __exit__(self, *raised: object) -> None:
        self._stack.close()

    @cached_property
    def context(self) -> mujoco.MjrContext:
        """The context to draw in.

        Raises:
            RenderingError: if no OpenGL works.
        """
        self._stack.callback(new_context(self.width, self.height).free)
        context = mujoco.MjrContext(self.model(bases()[0]), mujoco.mjtFontScale.mjFONTSCALE_100.value)
        self._stack.callback(context.free)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
        return context

    @property
    def aspect(self) -> float:
        """Width over height."""
        return self.width / self.height

    def model(self, variant: Variant, mjcf: str | None = None) -> mujoco.MjModel:
        """Return the model that is drawn for ``variant``; ``mjcf`` is its text where it is the archive's."""
        text = model_text(variant, mjcf)
        if (variant, text) not in self._models:
            self._models[variant, text] = scene_model(
                variant, text, width=self.width, height=self.height, fine=self._fine
            )
        return self._models[variant, text]

    def shoot(
        self, variant: Variant, positions: Iterable[Any], camera: Camera, mjcf: str | None = None
    ) -> Iterator[Image.Image]:
        """Yield a picture for each position and its place of the camera.

        Raises:
            RenderingError: if no OpenGL works.
        """
        context = self.context
        model = self.model(variant, mjcf)
        data, option, view = mujoco.MjData(model), mujoco.MjvOption(), mujoco.MjvCamera()
        scene = mujoco.MjvScene(model, maxgeom=100)
        view.azimuth, view.elevation, view.distance = AZIMUTH, ELEVATION, camera.distance
        rectangle = mujoco.MjrRect(0, 0, self.width, self.height)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        for position, lookat in zip(positions, camera.lookat, strict=True):
            data.qpos[:] = position
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
            view.lookat[:] = lookat
            mujoco.mjv_updateScene(model, data, option, None, view, everything, scene)
            mujoco.mjr_render(rectangle, scene, context)
            pixels = np.empty((self.height, self.width, 3), np.uint8)
            mujoco.mjr_readPixels(pixels, None, rectangle, context)
            # The first row of OpenGL is the lowest row of the picture.
            yield Image.fromarray(pixels[::-1])
