"""Position of the camera: the complete robot is visible in every picture.

This module needs no OpenGL. The robots consist of capsules and spheres, and a capsule is visible if the
spheres at its two ends are. The distance of the camera follows from them in closed form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from imujoco_minari.envs.mjcf import Floats, round_geoms

# Degrees. The camera looks slightly from the front and from vertical, so a far leg shows behind a near one.
AZIMUTH, ELEVATION = 104.0, -11.0
FIELD_OF_VIEW = 30.0
# Share of the picture that the robot may fill.
FILL = 0.9
# Seconds over which the camera's path is averaged, so it follows the robot smoothly.
SMOOTHING = 0.5


@dataclass(frozen=True, eq=False)
class Capsules:
    """The ends of all capsules of a robot along a motion.

    Attributes:
        ends: positions of the ends in m, of shape (frames, ends, 3).
        radii: radius at each end in m, of shape (ends,).
        sideways: y of the torso in m, of shape (frames,); 0 for robots that move in a plane.
    """

    ends: Floats
    radii: Floats
    sideways: Floats

    @property
    def middle(self) -> Floats:
        """The middle of the robot's extent along x in m, of shape (frames,)."""
        low = (self.ends[:, :, 0] - self.radii).min(axis=1)
        high = (self.ends[:, :, 0] + self.radii).max(axis=1)
        return np.asarray((low + high) / 2)

    @property
    def top(self) -> float:
        """The height of the highest point of the motion, in m."""
        return float((self.ends[:, :, 2] + self.radii).max())


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera that looks at one point per frame, from a constant distance.

    Attributes:
        lookat: the points in m, of shape (frames, 3).
        distance: distance from the points, in m.
    """

    lookat: Floats
    distance: float


def axes() -> tuple[Floats, Floats, Floats]:
    """Return the camera's right, up and forward unit vectors in world coordinates."""
    azimuth, elevation = np.radians(AZIMUTH), np.radians(ELEVATION)
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = np.cos(elevation) * level + [0.0, 0.0, np.sin(elevation)]
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    return right, np.cross(right, forward), forward


def capsules(model: mujoco.MjModel, positions: Floats) -> Capsules:
    """Return a robot's capsules, and its spheres as capsules without length, at positions (frames, nq)."""
    data = mujoco.MjData(model)
    chosen, radii, halves = round_geoms(model)
    ends, sideways = np.empty((len(positions), 2 * len(chosen), 3)), np.empty(len(positions))
    for frame, position in enumerate(positions):
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        along = data.geom_xmat.reshape(-1, 3, 3)[chosen, :, 2] * halves[:, None]
        centres = data.geom_xpos[chosen]
        ends[frame] = np.concatenate([centres - along, centres + along])
        sideways[frame] = data.xpos[1, 1]
    return Capsules(ends, np.concatenate([radii, radii]), sideways)


def follow(motions: Sequence[Capsules], aspect: float, frame_seconds: float) -> list[Camera]:
    """Return a camera for each motion. All have one distance and height, so sizes can be compared.

    ``aspect`` is the width of the picture over its height, ``frame_seconds`` the time between two frames.
    """
    height = max(motion.top for motion in motions) / 2
    window = round(SMOOTHING / frame_seconds)
    lookats, distances = [], []
    for motion in motions:
        path, aside = _moving_average(motion.middle, window), _moving_average(motion.sideways, window)
        lookats.append(np.stack([path, aside, np.full_like(path, height)], axis=-1))
        distances.append(_fitting_distance(motion, lookats[-1], aspect))
    return [Camera(lookat, max(distances)) for lookat in lookats]


def _fitting_distance(motion: Capsules, lookat: Floats, aspect: float) -> float:
    """Return the smallest distance in m from which all capsules are visible in all frames."""
    right, up, forward = axes()
    relative = motion.ends - lookat[:, None, :]
    tangent = FILL * np.tan(np.radians(FIELD_OF_VIEW) / 2)
    horizontal = (np.abs(relative @ right) + motion.radii) / (tangent * aspect)
    vertical = (np.abs(relative @ up) + motion.radii) / tangent
    return float((np.maximum(horizontal, vertical) - relative @ forward + motion.radii).max())


def _moving_average(values: Floats, window: int) -> Floats:
    """Return the moving average of ``values``, which are extended by odd reflection at both ends."""
    half = min(window // 2, len(values) - 1)
    padded = np.pad(values, half, mode="reflect", reflect_type="odd")
    return np.convolve(padded, np.full(2 * half + 1, 1 / (2 * half + 1)), mode="valid")
