"""The original's data as Minari datasets: its episodes as they are, or its policies rolled out anew."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from minari.data_collector import EpisodeBuffer

from imujoco_minari.envs import environment_spec
from imujoco_minari.errors import DatasetError, ImujocoError, NotFoundError
from imujoco_minari.importing.archive import Archive
from imujoco_minari.importing.columns import ARRAY, Layout, read_table
from imujoco_minari.importing.physics import Physics
from imujoco_minari.importing.safe_unpack import Array, read_npz
from imujoco_minari.importing.transitions import Cut, Transitions, cut, episodes, fidelity
from imujoco_minari.policies import Policy, random_policy, read_actor
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.rollouts import episode_seed
from imujoco_minari.publishing.publisher import NewDataset, Published, publish_episodes
from imujoco_minari.storage import file_format
from imujoco_minari.storage.metadata import provenance
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


def import_archive(archive: Archive, variants: Iterable[OriginalVariant], how: Import) -> Iterator[Published]:
    """Publish variants of an archive and yield each outcome as it comes, failures included."""
    for variant in variants:
        dataset_id = variant.dataset_id(how.tier)
        try:
            yield (recollect if how.recollect else import_variant)(archive, variant, how)
        except ImujocoError as error:
            yield Published(dataset_id, error=str(error), missing=isinstance(error, NotFoundError))


def import_variant(archive: Archive, variant: OriginalVariant, how: Import) -> Published:
    """Publish the archive's episodes of a variant as ``imujoco-original/<variant>-v0``.

    Raises:
        ImujocoError: when a file is missing or is not what it must be, or the root cannot be written.
    """
    source, mjcf = archive.mjcf(variant)
    member = archive.member(variant, "dataset")
    with member.on_disk() as path:
        table, digest = _table(path, str(member)), file_format.file_sha256(path)
    transitions, layout, checks = read_table(table, variant.robot, str(member), how.columns)
    spec = environment_spec(variant, mjcf)
    with Physics(spec) as physics:
        found = cut(transitions, physics)
        near = fidelity(transitions, found, physics)
        metadata = _common(variant, spec, "SAC", _description(variant, layout, transitions, found)) | {
            "mjcf_source": source,
            **_reference_maximum(transitions, found),
            "source": f"dataset/sac-{variant}.npz",
            "source_sha256": digest,
            "source_columns": str(layout),
            "source_checks": [str(check) for check in checks],
            "one_step_difference": near.asdict(),
        }
        attributes = _attributes(variant, how.tier) | {file_format.REPLAYABLE: False}
        dataset = NewDataset(variant.dataset_id(how.tier), attributes, mjcf, metadata)
        return publish_episodes(dataset, spec, episodes(transitions, found, physics), force=how.force)


def recollect(archive: Archive, variant: OriginalVariant, how: Import) -> Published:
    """Roll the archive's policy out in the archive's model and publish it as the tier ``recollected``.

    Raises:
        ImujocoError: when a file is missing or is not what it must be, or the root cannot be written.
    """
    source, mjcf = archive.mjcf(variant)
    with archive.member(variant, "policies").on_disk() as path:
        policy = read_actor(path).for_robot(variant.robot)
        digest = file_format.file_sha256(path)
    spec = environment_spec(variant, mjcf)
    description = (
        f"The original iMuJoCo policy of {variant}, from {SOURCE}, rolled out deterministically for "
        f"{how.episodes} episodes in the original model under Gymnasium's v5 rules and MuJoCo "
        f"{version('mujoco')}. The original's own episodes were made with gym's v3 environments."
    )
    metadata = _common(variant, spec, policy.algorithm, description) | {
        "mjcf_source": source,
        "source": f"policies/sac-{variant}.zip",
        "source_sha256": digest,
        "policy_sha256": policy.sha256,
        "policy_deterministic": policy.deterministic,
        "seed": how.seed,
    }
    dataset = NewDataset(variant.dataset_id(how.tier), _attributes(variant, how.tier), mjcf, metadata)
    return publish_episodes(dataset, spec, _rollouts(spec, policy, how), force=how.force)


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


def _common(variant: OriginalVariant, spec: EnvSpec, algorithm: str, description: str) -> dict[str, Any]:
    """Return the metadata that imported and recollected datasets share."""
    env, policy = gym.make(spec), random_policy(variant.robot)
    try:
        random = evaluate(env, policy, episodes=REFERENCE_EPISODES)
    finally:
        env.close()
    return {
        **provenance(authors=AUTHORS, code=CODE, algorithm=algorithm, description=description),
        "license": "Apache-2.0",
        "ref_min_score": random.return_mean,
        "num_episodes_average_score": random.episodes,
        "ref_min_evaluation": random.asdict(),
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
