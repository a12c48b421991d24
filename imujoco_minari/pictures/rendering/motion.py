"""Motions: the positions of a robot during an episode, under a policy or as a dataset recorded it.

They come from the variant's own environment. A recorded episode is reset with its seed and stepped by its
actions, as verification does. Imported episodes have no seeds. Their observations hold all positions but the
distance run, which is the sum of the recorded velocities.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.envs.mjcf import Floats
from imujoco_minari.envs.registration import make
from imujoco_minari.errors import (
    DatasetError,
    DatasetNotFoundError,
    ImujocoError,
    PolicyNotFoundError,
    RenderingError,
)
from imujoco_minari.policies import Array, Policy, load_policy
from imujoco_minari.short_repr import short_repr
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.storage.containment import LinkedFiles
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.storage.missing import not_in_root
from imujoco_minari.variants import Variant, specification
from imujoco_minari.variants.original import variant_of
from imujoco_minari.verification.identity import dataset_models


@dataclass(frozen=True, eq=False)
class Motion:
    """The positions of a robot during one episode.

    Attributes:
        variant: the robot that moves.
        positions: generalised positions, of shape (steps + 1, nq).
        rewards: of shape (steps,).
        timestep: seconds an environment step takes.
        terminated: whether the robot left its healthy range, and did not reach the time limit.
        title: the policy or the recorded episode, in a few words.
        divergence: of a replay, the largest difference from a recorded observation; 0 when exact.
        mjcf: the text of the model, for a variant of the original archive.
        tier: of a recorded episode, the tier of the policy that moved it; empty for others.
    """

    variant: Variant
    positions: Floats
    rewards: Floats
    timestep: float
    terminated: bool
    title: str = ""
    divergence: float = 0.0
    mjcf: str | None = None
    tier: str = ""

    __repr__ = short_repr

    @property
    def duration(self) -> float:
        """Duration in simulated seconds."""
        return len(self.rewards) * self.timestep

    @property
    def total(self) -> float:
        """The undiscounted return."""
        return float(self.rewards.sum())

    def until(self, seconds: float | None) -> Motion:
        """Return the first ``seconds`` of the motion, or all of it for None."""
        steps = len(self.rewards) if seconds is None else max(1, round(seconds / self.timestep))
        if steps >= len(self.rewards):
            return self
        return replace(
            self, positions=self.positions[: steps + 1], rewards=self.rewards[:steps], terminated=False
        )


def perform(
    variant: Variant, policy: Policy, *, seed: int = 0, seconds: float | None = None, title: str = ""
) -> Motion:
    """Roll a policy out in a variant and return the motion.

    It lasts at most ``seconds`` simulated seconds; None means a complete episode. Without a ``title``, the
    motion is named after the policy's algorithm.
    """
    rng = np.random.default_rng(seed)
    motion, _ = _simulate(variant, seed, lambda observation: policy.act(observation, rng))
    return replace(motion, title=title or f"{policy.algorithm} policy").until(seconds)


def replay(dataset_id: str, episode: int = 0) -> Motion:
    """Return the motion of a recorded episode of a dataset or a collection of the Minari root.

    Raises:
        DatasetNotFoundError: if there is no such dataset or episode.
        DatasetError: if the episode cannot be read, or its variant is from the original's archive.
    """
    path = file_format.main_file(minari_root.dataset_folder(dataset_id) / "data")
    if not path.is_file():
        raise not_in_root(dataset_id)
    try:
        variant, mjcf, tier, seed, arrays = _read(path, dataset_id, episode)
    except ImujocoError:
        raise
    except (OSError, KeyError, RuntimeError, TypeError, ValueError, AttributeError) as error:
        raise DatasetError(f"{dataset_id}: episode {episode} cannot be read: {error}") from None
    title = f"{tier}, episode {episode}"
    if seed is None:
        return replace(_as_observed(variant, mjcf, arrays), title=f"{title}, as observed", tier=tier)
    actions = iter(arrays["actions"])
    motion, observations = _simulate(variant, seed, lambda _: next(actions), len(arrays["actions"]), mjcf)
    # The replay may end before the recording.
    differences = np.abs(observations - arrays["observations"][: len(observations)])
    return replace(motion, title=title, divergence=float(differences.max()), tier=tier)


def of_variant(
    variant: Variant,
    tier: str,
    policy: Path | None,
    *,
    seed: int = 0,
    beside_base: bool = False,
    seconds: float | None = None,
) -> list[Motion]:
    """Return the motion of a variant under its policy of a tier, or under a policy file.

    With ``beside_base``, the motion of the base robot comes first, under its own policy of the tier or under
    the same file. ``seconds`` is the length of the motions; None means the complete episode.

    Raises:
        PolicyNotFoundError: if there is no such policy.
    """
    variants = [variant.base, variant] if beside_base and variant != variant.base else [variant]
    title = f"{tier if policy is None else policy.stem} policy, seed {seed}"
    return [
        perform(each, load_policy(each, tier=tier, path=policy), seed=seed, seconds=seconds, title=title)
        for each in variants
    ]


def of_dataset(
    dataset_id: str, episode: int, *, beside_base: bool = False, seconds: float | None = None
) -> list[Motion]:
    """Return the motion of a recorded episode.

    With ``beside_base``, a motion of the base robot comes first: the episode of the same number in its
    dataset of the same tier, or without such a dataset, its policy of the tier. ``seconds`` is the length of
    the motions; None means the complete episode.

    Raises:
        DatasetNotFoundError: if there is no such dataset or episode.
        RenderingError: if the base robot has neither a dataset nor a policy of the tier.
    """
    motion = replay(dataset_id, episode).until(seconds)
    variant, tier = motion.variant, motion.tier
    if not beside_base or variant == variant.base:
        return [motion]
    base = variant.base.dataset_id(tier)
    if minari_root.exists(base):
        return [replay(base, episode).until(seconds), motion]
    try:
        policy = load_policy(variant.base, tier=tier)
    except PolicyNotFoundError:
        raise RenderingError(
            f"{variant.base} has no dataset and no policy of the tier {tier}: publish {base}, "
            "or leave out --beside-base"
        ) from None
    return [perform(variant.base, policy, seed=episode, seconds=seconds, title=f"{tier} policy"), motion]


def _simulate(
    variant: Variant,
    seed: int,
    act: Callable[[Array], Array],
    steps: float = inf,
    mjcf: str | None = None,
) -> tuple[Motion, Array]:
    """Run an episode to its end, or for ``steps`` steps; return its motion and its observations."""
    with closing(make(variant, mjcf)) as env:
        robot: Any = env.unwrapped
        observations = [env.reset(seed=seed)[0]]
        positions = [np.array(robot.data.qpos)]
        rewards: list[float] = []
        terminated = truncated = False
        while len(rewards) < steps and not (terminated or truncated):
            observation, reward, terminated, truncated, _ = env.step(act(observations[-1]))
            observations.append(observation)
            positions.append(np.array(robot.data.qpos))
            rewards.append(float(reward))
        path, earned = np.array(positions), np.array(rewards)
        motion = Motion(variant, path, earned, float(robot.dt), bool(terminated), mjcf=robot.mjcf)
    return motion, np.array(observations)


def _as_observed(variant: Variant, mjcf: str | None, arrays: dict[str, Array]) -> Motion:
    """Return the motion of an episode whose seed is not known, from its observations."""
    with closing(make(variant, mjcf)) as env:
        robot: Any = env.unwrapped
        step, size = float(robot.dt), robot.model.nq
    # The positions that are not observed are the distances run: forward, and for some robots sideways.
    others = specification(variant.robot).observed_positions
    hidden = size - others
    observations = arrays["observations"]
    velocities = observations[1:, others : others + hidden]
    run = np.concatenate([np.zeros((1, hidden)), np.cumsum(velocities, axis=0) * step])
    positions = np.column_stack([run, observations[:, :others]]).astype(np.float64)
    terminated = bool(arrays["terminations"][-1])
    return Motion(variant, positions, arrays["rewards"], step, terminated, mjcf=mjcf)


def _read(
    path: Path, dataset_id: str, episode: int
) -> tuple[Variant, str | None, str, int | None, dict[str, Array]]:
    """Return the variant of an episode, the text of its model, its tier, its seed, and its arrays.

    The text is None if the model follows from the id. The seed is None if it is not known.
    """
    with LinkedFiles(path.absolute()) as files:
        file = files.file
        if not 0 <= episode < len(file):
            raise DatasetNotFoundError(f"{dataset_id} has no episode {episode}; valid: 0 to {len(file) - 1}")
        files.check(episode)
        group = file[file_format.episode_name(episode)]
        attributes = dict(group.attrs)
        arrays = {key: group[key][()] for key in file_format.ARRAYS}
    # This makes a user's robot known. So it comes before the variant and its specification.
    models = dataset_models(read_metadata(path.parent))
    variant = variant_of(attributes)
    seed = int(attributes["seed"]) if bool(attributes.get(file_format.REPLAYABLE, True)) else None
    if seed is not None and seed < 0:
        raise ValueError(f"its seed is {seed}")
    steps, (observation, action) = len(arrays["actions"]), specification(variant.robot).sizes
    shapes = {"observations": (steps + 1, observation), "actions": (steps, action)}
    for key, array in arrays.items():
        if not steps or array.shape != shapes.get(key, (steps,)):
            raise ValueError(f"its {key} have shape {array.shape}")
    return variant, models.get(str(variant)), str(attributes.get("tier", "")), seed, arrays
