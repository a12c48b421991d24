"""The motion of a recorded episode: replayed from its seed and actions, or read from its observations.

Most episodes are reset with their recorded seed and stepped by their recorded actions, as verification
does. Imported episodes have no seeds. Their observations hold all positions but the distance run, which
is the sum of the recorded velocities.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass

import h5py
import numpy as np

from imujoco_minari.envs.mjcf import compile_mjcf, model_text
from imujoco_minari.envs.registration import make
from imujoco_minari.errors import DatasetError, DatasetNotFoundError, ImujocoError
from imujoco_minari.pictures.rendering.motion import Motion, PositionRecorder
from imujoco_minari.policies import Array
from imujoco_minari.storage import containment, file_format, minari_root
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.storage.missing import not_in_root
from imujoco_minari.variants import Variant, specification
from imujoco_minari.variants.original import variant_of
from imujoco_minari.verification.identity import dataset_models


@dataclass(frozen=True, eq=False)
class Recorded:
    """One recorded episode.

    Attributes:
        dataset_id: the dataset.
        number: of the episode in it.
        variant: the variant that moved.
        tier: tier of the policy that moved it.
        seed: seed of the reset; None if it is not known.
        observations: of shape (steps + 1, n).
        actions: of shape (steps, m).
        rewards: of shape (steps,).
        terminated: whether the robot left its healthy range.
        mjcf: the text of the model, for a variant of the original archive.
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
    mjcf: str | None = None

    @property
    def title(self) -> str:
        """Tier and number of the episode, for a caption."""
        return f"{self.tier}, episode {self.number}"

    def motion(self) -> Motion:
        """Return the positions of the episode: replayed if its seed is known, or else as observed."""
        return self._from_observations() if self.seed is None else self._replay()

    def _replay(self) -> Motion:
        with closing(PositionRecorder(make(self.variant, self.mjcf))) as recorder:
            observation, _ = recorder.reset(seed=self.seed)
            divergence = float(np.abs(observation - self.observations[0]).max())
            for action, expected in zip(self.actions, self.observations[1:], strict=True):
                observation, _, terminated, truncated, _ = recorder.step(action)
                divergence = max(divergence, float(np.abs(observation - expected).max()))
                if terminated or truncated:
                    break
            return recorder.motion(self.variant, self.title, divergence)

    def _from_observations(self) -> Motion:
        with closing(make(self.variant, self.mjcf)) as env:
            step = float(env.unwrapped.dt)  # type: ignore[attr-defined]
        # The positions that are not observed are the distances run: forward, and for some robots sideways.
        others = specification(self.variant.robot).observed_positions
        hidden = compile_mjcf(model_text(self.variant, self.mjcf)).nq - others
        velocities = self.observations[1:, others : others + hidden]
        run = np.concatenate([np.zeros((1, hidden)), np.cumsum(velocities, axis=0) * step])
        positions = np.column_stack([run, self.observations[:, :others]]).astype(np.float64)
        title = f"{self.title}, as observed"
        return Motion(self.variant, positions, self.rewards, step, self.terminated, title, mjcf=self.mjcf)


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
        raise not_in_root(dataset_id)
    try:
        with h5py.File(path, "r") as file:
            if not 0 <= episode < len(file):
                raise DatasetNotFoundError(
                    f"{dataset_id} has no episode {episode}; valid: 0 to {len(file) - 1}"
                )
            containment.check_episode(file, episode, path.parent)
            models = dataset_models(read_metadata(path.parent))
            return _read(file[file_format.episode_name(episode)], dataset_id, episode, models)
    except ImujocoError:
        raise
    except (OSError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise DatasetError(f"{dataset_id}: episode {episode} cannot be read: {error}") from None


def _read(group: h5py.Group, dataset_id: str, number: int, models: Mapping[str, str]) -> Recorded:
    variant = variant_of(group.attrs)
    replayable = bool(group.attrs.get(file_format.REPLAYABLE, True))
    seed = int(group.attrs["seed"]) if replayable else None
    if seed is not None and seed < 0:
        raise ValueError(f"its seed is {seed}")
    arrays = {key: group[key][()] for key in file_format.ARRAYS}
    steps, (observation, action) = len(arrays["actions"]), specification(variant.robot).sizes
    shapes = {"observations": (steps + 1, observation), "actions": (steps, action)}
    for key, array in arrays.items():
        if not steps or array.shape != shapes.get(key, (steps,)):
            raise ValueError(f"its {key} have shape {array.shape}")
    return Recorded(
        dataset_id,
        number,
        variant,
        str(group.attrs.get("tier", "")),
        seed,
        arrays["observations"],
        arrays["actions"],
        arrays["rewards"],
        bool(arrays["terminations"][-1]),
        models.get(str(variant)),
    )
