"""Variants as Gymnasium environments.

Each class is Gymnasium's own v5 environment of the robot with the model of a variant. Observations,
actions, rewards and termination are Gymnasium's; only the model and, for length variants, the healthy
height range differ.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from functools import cache, lru_cache
from inspect import signature
from typing import Any, cast

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from gymnasium.envs.mujoco.mujoco_env import MujocoEnv
from gymnasium.envs.mujoco.walker2d_v5 import Walker2dEnv
from gymnasium.envs.registration import load_env_creator
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from imujoco_minari.envs import gl
from imujoco_minari.envs.mjcf import compile_mjcf, healthy_z_range, model_text, variant_model
from imujoco_minari.envs.untrusted_mjcf import check_mjcf
from imujoco_minari.errors import CatalogueError, VariantError
from imujoco_minari.variants import Variant, adopt_page, specification
from imujoco_minari.variants.original import OriginalVariant
from imujoco_minari.variants.robots import forget_on_error

Array = NDArray[Any]

# As arrays: NumPy takes half a microsecond to convert the same number at each call.
_LOWEST_VELOCITY, _HIGHEST_VELOCITY = np.array(-10.0), np.array(10.0)


@lru_cache(maxsize=4)
def _compiled(text: str) -> mujoco.MjModel:
    """Compile a text once for all environments that run it. Each takes a copy."""
    return compile_mjcf(text)


class VariantEnv(MujocoEnv, EzPickle):
    """The base class of the robots' variant environments.

    Args:
        variant: a variant id, as in ``hopper-massdec_25_leggeom``.
        mjcf: the text of the model, for a variant of the original archive. It may come from anywhere.
        page: the texts of the robot's page, for a robot of the user. They may come from anywhere.
        **kwargs: what Gymnasium's environment of the robot takes, ``render_mode`` among them.

    Attributes:
        variant: the :class:`~imujoco_minari.variants.ids.Variant`.

    Raises:
        VariantError: when ``variant`` is not the id of a variant of the class's robot.
        ModelError: when the text is refused.
        CatalogueError: when the page is wrong, or does not agree with the robot's environment.
    """

    @forget_on_error()
    def __init__(
        self, variant: str, mjcf: str | None = None, page: Mapping[str, str] | None = None, **kwargs: Any
    ) -> None:
        if page is not None:
            adopt_page(variant.partition("-")[0], page)
        self.variant = (Variant if mjcf is None else OriginalVariant).parse(variant)
        if specification(self.variant.robot).environment != self.robot_environment:
            raise VariantError(f"{variant!r} is not a variant of {self.robot_environment}")
        if mjcf is not None:
            check_mjcf(mjcf, variant)
        self._text = mjcf
        z_range = healthy_z_range(self.variant if mjcf is None else self.variant.base)
        defaults = {} if z_range is None else {"healthy_z_range": z_range}
        if page is not None and defaults and "healthy_z_range" not in signature(super().__init__).parameters:
            raise CatalogueError(
                f"the page of {self.variant.robot} has healthy_z_range, which {self.robot_environment} "
                "does not take"
            )
        super().__init__(**(defaults | kwargs))
        # The parent recorded its own arguments for pickling; these make this environment again.
        EzPickle.__init__(self, variant, mjcf, page, **kwargs)
        if page is not None and not kwargs:
            self._check_page()

    robot_environment: str

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.variant})"

    def render(self) -> Any:
        """Return a picture, or show it in a window in the mode ``human``.

        Raises:
            RenderingError: when no OpenGL works for off-screen pictures.
        """
        # Gymnasium would try GLFW first, which fails without a display.
        if self.render_mode != "human":
            gl.backend()
        return super().render()  # type: ignore[no-untyped-call]

    @property
    def mjcf(self) -> str:
        """The MJCF text that the simulation runs."""
        return model_text(self.variant, self._text)

    def _check_page(self) -> None:
        """Check what the user's page states about the environment's sizes and times."""
        page = specification(self.variant.robot)
        found = {
            "observation_size": float(np.prod(self.observation_space.shape or ())),
            "action_size": float(self.model.nu),
            "action_bound": float(np.abs(self.model.actuator_ctrlrange).max(initial=0.0)),
            "steps_per_second": 1 / float(self.dt),
        }
        for key, value in found.items():
            if not np.isclose(getattr(page, key), value):
                raise CatalogueError(
                    f"the page of {self.variant.robot} states {key} = {getattr(page, key):g}, "
                    f"but its environment has {value:g}"
                )
        if not getattr(self, "is_healthy", True):
            raise CatalogueError(
                f"the page of {self.variant.robot}: its robot is not healthy at rest, so an episode would "
                f"have one step; its healthy_z_range is {page.healthy_z_range}"
            )

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        model = variant_model(self.variant) if self._text is None else copy(_compiled(self._text))
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, self.width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, self.height)
        return model, mujoco.MjData(model)


class QuickVariantEnv(VariantEnv):
    """The base class of planar robots, whose observations are their positions and velocities alone.

    Gymnasium's step() spends 10 us (HalfCheetah) to 30 us (Hopper) outside MuJoCo, a third of the whole. It
    calls the methods below most often. These return the same to the bit, in a third of the time.
    """

    _ctrl_cost_weight: float
    _exclude_current_positions_from_observation: bool

    def do_simulation(self, ctrl: Array, n_frames: int) -> None:
        """Apply an action for ``n_frames`` steps of the simulation.

        Raises:
            ValueError: when the action does not have the shape of the action space.
        """
        if np.shape(ctrl) != self.action_space.shape:
            raise ValueError(
                f"Action dimension mismatch. Expected {self.action_space.shape}, found {np.shape(ctrl)}"
            )
        self._step_mujoco_simulation(ctrl, n_frames)  # type: ignore[no-untyped-call]

    def control_cost(self, action: Array) -> Any:
        """Return the weighted sum of the squared action."""
        return self._ctrl_cost_weight * np.add.reduce(np.square(action), axis=None)

    def _get_obs(self) -> Array:
        position = self.data.qpos
        if self._exclude_current_positions_from_observation:
            position = position[1:]
        return np.concatenate((position, self._observed_velocity()))

    def _observed_velocity(self) -> Any:
        return self.data.qvel


class ClippedVelocity:
    """Clips observed velocities to [-10, 10], as Gymnasium does for Hopper and Walker2d."""

    data: mujoco.MjData

    def _observed_velocity(self) -> Any:
        return np.minimum(np.maximum(self.data.qvel, _LOWEST_VELOCITY), _HIGHEST_VELOCITY)


class HopperVariantEnv(ClippedVelocity, QuickVariantEnv, HopperEnv):
    """``Hopper-v5`` with the model of a variant (observation 11, action 3)."""

    robot_environment = "Hopper-v5"

    @property
    def is_healthy(self) -> bool:
        """Whether height, angle and all other state lie in their healthy ranges."""
        position, velocity = self.data.qpos.tolist(), self.data.qvel.tolist()
        (min_z, max_z), (min_angle, max_angle) = self._healthy_z_range, self._healthy_angle_range
        min_state, max_state = self._healthy_state_range
        return (
            min_z < position[1] < max_z
            and min_angle < position[2] < max_angle
            and all(min_state < value < max_state for value in position[2:] + velocity)
        )


class HalfCheetahVariantEnv(QuickVariantEnv, HalfCheetahEnv):
    """``HalfCheetah-v5`` with the model of a variant (observation 17, action 6)."""

    robot_environment = "HalfCheetah-v5"


class Walker2dVariantEnv(ClippedVelocity, QuickVariantEnv, Walker2dEnv):
    """``Walker2d-v5`` with the model of a variant (observation 17, action 6)."""

    robot_environment = "Walker2d-v5"


@cache
def variant_class(title: str) -> type[VariantEnv]:
    """Return the class of the variants of a Gymnasium environment, of which ``title`` is the name, as in Ant.

    It is one of the quicker classes of this module, or else Gymnasium's class with the model of a variant.

    Raises:
        CatalogueError: when Gymnasium has no such MuJoCo environment of version 5.
    """
    if f"{title}VariantEnv" in globals():
        return cast(type[VariantEnv], globals()[f"{title}VariantEnv"])
    environment = f"{title}-v5"
    spec = gym.registry.get(environment)
    if spec is None or not str(spec.entry_point).startswith("gymnasium.envs.mujoco"):
        raise CatalogueError(f"{environment} is not one of Gymnasium's MuJoCo environments")
    stock = cast(type[MujocoEnv], load_env_creator(str(spec.entry_point)))
    # Pickles and specs find the class under this name: see envs.__getattr__.
    attributes = {
        "robot_environment": environment,
        "__module__": "imujoco_minari.envs",
        "__doc__": f"``{environment}`` with the model of a variant.",
    }
    return type(f"{title}VariantEnv", (VariantEnv, stock), attributes)
