"""The motion of a recorded episode: replayed from its seed and actions, or read from its observations.

An episode with a seed is replayed as verification does. External data has no seeds. Its observations contain
all positions except the travelled distance, which is the sum of the recorded velocities.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from imujoco_minari.envs.registration import make
from imujoco_minari.errors import DatasetError, DatasetNotFoundError
from imujoco_minari.pictures.rendering.motion import Motion, PositionRecorder, timestep
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.variants import Variant
from imujoco_minari.variants.original import is_original

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Recorded:
    """One recorded episode.

    Attributes:
        dataset_id: id of the dataset.
        number: number of the episode in the dataset.
        variant: the variant.
        tier: tier of the policy.
        seed: seed of the reset; None if unknown.
        observations: observations of shape (steps + 1, n).
        actions: actions of shape (steps, m).
        rewards: rewards of shape (steps,).
        terminated: whether the episode ended because the robot left its healthy range.
    """

    dataset_id: str
    number: int
    variant: Variant
    tier: str
    seed: int | None
    observations: Array
    actions: Array
    rewards: Array
    terminated: bool

    @property
    def title(self) -> str:
        """Tier and number of the episode, for a caption."""
        return f"{self.tier}, episode {self.number}"

    def motion(self) -> Motion:
        """Return the positions of the episode: replayed if its seed is known, or else as observed."""
        return self._from_observations() if self.seed is None else self._replay()

    def _replay(self) -> Motion:
        recorder = PositionRecorder(make(self.variant))
        try:
            observation, _ = recorder.reset(seed=self.seed)
            divergence = float(np.abs(observation - self.observations[0]).max())
            for action, expected in zip(self.actions, self.observations[1:], strict=True):
                observation, _, terminated, truncated, _ = recorder.step(action)
                divergence = max(divergence, float(np.abs(observation - expected).max()))
                if terminated or truncated:
                    break
            return recorder.motion(self.variant, self.title, divergence)
        finally:
            recorder.close()

    def _from_observations(self) -> Motion:
        step = timestep(self.variant)
        # An observation consists of all positions except the first, then of all velocities.
        position_count = (self.observations.shape[1] - 1) // 2
        travelled = np.concatenate([[0.0], np.cumsum(self.observations[1:, position_count]) * step])
        positions = np.column_stack([travelled, self.observations[:, :position_count]]).astype(np.float64)
        title = f"{self.title}, as observed"
        return Motion(self.variant, positions, self.rewards, step, self.terminated, title)


def replay(dataset_id: str, episode: int = 0) -> Motion:
    """Return the motion of a recorded episode of a dataset of this package.

    Args:
        dataset_id: id of a dataset or a collection of the Minari root.
        episode: number of the episode.

    Raises:
        DatasetNotFoundError: if there is no such dataset or episode.
        DatasetError: if the episode cannot be read, or its variant is from the original's archive.
    """
    return read_recorded(dataset_id, episode).motion()


def read_recorded(dataset_id: str, episode: int = 0) -> Recorded:
    """Read one episode of a dataset of the Minari root.

    Raises:
        DatasetNotFoundError: if there is no such dataset or episode.
        DatasetError: if the episode cannot be read, or its variant is from the original's archive.
    """
    path = file_format.main_file(minari_root.dataset_folder(dataset_id) / "data")
    if not path.is_file():
        raise DatasetNotFoundError(
            f"{dataset_id} is not in the Minari root, {minari_root.datasets_root()}; see `minari list local`"
        )
    try:
        with h5py.File(path, "r") as file:
            if not 0 <= episode < len(file):
                raise DatasetNotFoundError(
                    f"{dataset_id} has no episode {episode}; valid: 0 to {len(file) - 1}"
                )
            return _parse_episode(file[f"episode_{episode}"], dataset_id, episode)
    except (OSError, KeyError, IndexError) as error:
        if isinstance(error, DatasetNotFoundError):
            raise
        raise DatasetError(f"{dataset_id}: episode {episode} cannot be read: {error}") from None


def _parse_episode(group: h5py.Group, dataset_id: str, number: int) -> Recorded:
    if is_original(group.attrs):
        raise DatasetError(
            f"{dataset_id}: its variant is from the original's archive, whose models cannot be drawn"
        )
    replayable = bool(group.attrs.get(file_format.REPLAYABLE, True))
    return Recorded(
        dataset_id,
        number,
        Variant.parse(str(group.attrs["variant"])),
        str(group.attrs.get("tier", "")),
        int(group.attrs["seed"]) if replayable else None,
        group["observations"][()],
        group["actions"][()],
        group["rewards"][()],
        bool(group["terminations"][-1]),
    )
