"""The original's data as Minari datasets: its episodes as they are, or its policies rolled out anew."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from minari.data_collector import EpisodeBuffer

from imujoco_minari.errors import DatasetError, ImujocoError, NotFoundError
from imujoco_minari.importing.archive import Archive
from imujoco_minari.importing.columns import ARRAY, Layout, read_table
from imujoco_minari.importing.physics import Physics
from imujoco_minari.importing.safe_unpack import Array, read_npz
from imujoco_minari.importing.transitions import Cut, Transitions, cut, episodes, fidelity
from imujoco_minari.policies import SIZES, Policy, RandomPolicy, read_actor
from imujoco_minari.policies.rollouts import episode_seed, evaluate
from imujoco_minari.publishing.publisher import External, Published, publish_episodes
from imujoco_minari.storage import file_format
from imujoco_minari.variants import EXPERT
from imujoco_minari.variants.original import CATALOGUE, ORIGINAL, RECOLLECTED, OriginalVariant

AUTHORS = frozenset({"Massimiliano Patacchiola", "Mingfei Sun", "Katja Hofmann", "Richard E. Turner"})
CODE = "https://github.com/mpatacchiola/imujoco"
SOURCE = "the iMuJoCo archive (Zenodo record 7971395, Apache-2.0)"
REFERENCE_EPISODES = 100


@dataclass(frozen=True)
class Import:
    """How an archive is imported.

    Attributes:
        columns: the columns of its tables, where the user states them.
        recollect: roll the archive's policies out instead of importing its episodes.
        episodes: how many episodes to roll out.
        seed: base seed of the rollouts.
        force: replace datasets that have the ids.
    """

    columns: str | None = None
    recollect: bool = False
    episodes: int = 100
    seed: int = 0
    force: bool = False

    @property
    def tier(self) -> str:
        """The tier under which the data are published."""
        return RECOLLECTED if self.recollect else EXPERT


def import_archive(
    archive: Archive,
    variants: Iterable[OriginalVariant],
    how: Import,
    on_variant: Callable[[], None] | None = None,
) -> Iterator[Published]:
    """Publish variants of an archive and yield each outcome as it comes, failures included."""
    for variant in variants:
        dataset_id = variant.dataset_id(how.tier)
        try:
            yield (recollect if how.recollect else import_variant)(archive, variant, how)
        except ImujocoError as error:
            yield Published(dataset_id, error=str(error), missing=isinstance(error, NotFoundError))
        if on_variant is not None:
            on_variant()


def import_variant(archive: Archive, variant: OriginalVariant, how: Import) -> Published:
    """Publish the archive's episodes of a variant as ``imujoco-original/<variant>-v0``.

    Raises:
        ImujocoError: when a file is missing or is not what it must be, or the root cannot be written.
    """
    source, mjcf = archive.mjcf(variant)
    member = archive.member(variant, "dataset")
    with member.on_disk() as path:
        table, digest = _table(path, str(member)), _sha256(path)
    transitions, layout, checks = read_table(table, variant.robot, str(member), how.columns)
    spec = variant.environment_spec(mjcf)
    with Physics(spec) as physics:
        found = cut(transitions, physics)
        near = fidelity(transitions, found, physics)
        metadata = _common(variant, spec, source) | {
            "algorithm_name": "SAC",
            "description": _description(variant, layout, transitions, found),
            **_reference_maximum(transitions, found),
            "source": f"dataset/sac-{variant}.npz",
            "source_sha256": digest,
            "source_columns": str(layout),
            "source_checks": [str(check) for check in checks],
            "one_step_difference": near.asdict(),
        }
        attributes = _attributes(variant, how.tier) | {file_format.REPLAYABLE: False}
        external = External(variant.dataset_id(how.tier), attributes, spec, mjcf, metadata)
        return publish_episodes(external, episodes(transitions, found, physics), force=how.force)


def recollect(archive: Archive, variant: OriginalVariant, how: Import) -> Published:
    """Roll the archive's policy out in the archive's model and publish it as the tier ``recollected``.

    Raises:
        ImujocoError: when a file is missing or is not what it must be, or the root cannot be written.
    """
    source, mjcf = archive.mjcf(variant)
    with archive.member(variant, "policies").on_disk() as path:
        policy = read_actor(path)
        digest = _sha256(path)
    policy.check(variant.robot)
    spec = variant.environment_spec(mjcf)
    metadata = _common(variant, spec, source) | {
        "algorithm_name": policy.algorithm,
        "description": (
            f"The original iMuJoCo policy of {variant}, from {SOURCE}, rolled out deterministically for "
            f"{how.episodes} episodes in the original model under Gymnasium's v5 rules and MuJoCo "
            f"{version('mujoco')}. The original's own episodes were made with gym's v3 environments."
        ),
        "source": f"policies/sac-{variant}.zip",
        "source_sha256": digest,
        "policy_sha256": policy.sha256,
        "policy_deterministic": policy.deterministic,
        "seed": how.seed,
    }
    external = External(variant.dataset_id(how.tier), _attributes(variant, how.tier), spec, mjcf, metadata)
    return publish_episodes(external, _rollouts(spec, policy, how), force=how.force)


def _rollouts(spec: EnvSpec, policy: Policy, how: Import) -> Iterator[EpisodeBuffer]:
    env = gym.make(spec)
    try:
        for number in range(how.episodes):
            yield _rollout(env, policy, episode_seed(how.seed, number))
    finally:
        env.close()


def _rollout(env: gym.Env[Any, Any], policy: Policy, seed: int) -> EpisodeBuffer:
    rng = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    observations, steps = [observation], []
    ended = False
    while not ended:
        action = policy.act(observation, rng)
        observation, reward, terminated, truncated, _ = env.step(action)
        observations.append(observation)
        steps.append((action, float(reward), bool(terminated), bool(truncated)))
        ended = terminated or truncated
    actions, rewards, terminations, truncations = (np.array(column) for column in zip(*steps, strict=True))
    return EpisodeBuffer(
        seed=seed,
        observations=np.array(observations),
        actions=actions,
        rewards=rewards,
        terminations=terminations,
        truncations=truncations,
    )


def _attributes(variant: OriginalVariant, tier: str) -> dict[str, Any]:
    return file_format.attributes(variant, tier) | {CATALOGUE: ORIGINAL}


def _common(variant: OriginalVariant, spec: EnvSpec, source: str) -> dict[str, Any]:
    """Return the metadata that imported and recollected datasets share."""
    env = gym.make(spec)
    try:
        random = evaluate(env, RandomPolicy(SIZES[variant.robot][1]), episodes=REFERENCE_EPISODES)
    finally:
        env.close()
    names = ("imujoco-minari", "mujoco", "gymnasium", "minari", "numpy")
    return {
        "author": set(AUTHORS),
        "code_permalink": CODE,
        "license": "Apache-2.0",
        "mjcf_source": source,
        "ref_min_score": random.return_mean,
        "num_episodes_average_score": random.episodes,
        "ref_min_evaluation": random.asdict(),
        "requirements": [f"{name}=={version(name)}" for name in ("mujoco", "gymnasium")],
        "versions": {name: version(name) for name in names},
    }


def _reference_maximum(transitions: Transitions, found: Cut) -> dict[str, Any]:
    """Return the archive's own mean return as the score of its expert, where the archive has rewards."""
    if transitions.rewards is None:
        return {}
    returns = [float(transitions.rewards[start:stop].sum()) for start, stop in found.bounds]
    return {
        "ref_max_score": float(np.mean(returns)),
        "ref_max_evaluation": {
            "episodes": len(returns),
            "return_mean": float(np.mean(returns)),
            "return_std": float(np.std(returns)),
            "source": "this dataset's own episodes",
        },
    }


def _description(variant: OriginalVariant, layout: Layout, transitions: Transitions, found: Cut) -> str:
    return " ".join(
        (
            f"The original iMuJoCo data of {variant}, from {SOURCE}: {len(found.bounds)} episodes, "
            f"{len(transitions)} steps, made by its authors with gym's v3 environments and mujoco-py. "
            f"Read as the columns {layout}. No seeds are known, so the episodes cannot be replayed. "
            "The environment is the original model under Gymnasium's v5 rules and today's MuJoCo.",
            *found.notes,
        )
    )


def _table(path: Path, name: str) -> Array:
    arrays = read_npz(path)
    if ARRAY not in arrays:
        raise DatasetError(f"{name}: holds no array {ARRAY!r}, but {', '.join(sorted(arrays))[:200]}")
    return arrays[ARRAY]


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
