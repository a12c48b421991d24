"""The original's data as Minari datasets: its own episodes, or new episodes by its policies."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from imujoco_minari.envs import environment_spec
from imujoco_minari.errors import DatasetError, ImujocoError
from imujoco_minari.importing.archive import Archive
from imujoco_minari.importing.columns import ARRAY, read_table
from imujoco_minari.importing.physics import Physics
from imujoco_minari.importing.safe_unpack import read_npz
from imujoco_minari.importing.transitions import Cut, cut
from imujoco_minari.policies import random_policy, read_actor
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.publishing.collector import collect
from imujoco_minari.publishing.new_dataset import (
    NewDataset,
    find_published,
    publish_episodes,
    publish_written,
)
from imujoco_minari.publishing.outcome import Published
from imujoco_minari.storage import file_format
from imujoco_minari.storage.metadata import provenance
from imujoco_minari.variants import EXPERT
from imujoco_minari.variants.original import CATALOGUE, ORIGINAL, REBUILT, RECOLLECTED, OriginalVariant

AUTHORS = frozenset({"Massimiliano Patacchiola", "Mingfei Sun", "Katja Hofmann", "Richard E. Turner"})
CODE = "https://github.com/mpatacchiola/imujoco"
SOURCE = "the iMuJoCo archive (Zenodo record 7971395, Apache-2.0)"
REBUILT_SOURCE = "an archive in the original's layout that imujoco-minari wrote"
REFERENCE_EPISODES = 100


@dataclass(frozen=True)
class Import:
    """How an archive is imported.

    Attributes:
        columns: the columns of its tables, where the user states them.
        recollect: whether :func:`import_archive` rolls the policies out instead of importing the episodes.
        episodes: how many episodes to roll out, with ``seed`` as base seed.
        force: replace datasets that have the ids.
    """

    columns: str | None = None
    recollect: bool = False
    episodes: int = 100
    seed: int = 0
    force: bool = False


def import_archive(archive: Archive, variants: Iterable[OriginalVariant], how: Import) -> Iterator[Published]:
    """Publish variants of an archive and yield each outcome as it comes, failures included."""
    act, tier = (recollect, RECOLLECTED) if how.recollect else (import_variant, EXPERT)
    for variant in variants:
        try:
            yield act(archive, variant, how)
        except ImujocoError as error:
            yield Published.failed(variant.dataset_id(tier), error)


def import_variant(archive: Archive, variant: OriginalVariant, how: Import) -> Published:
    """Publish the archive's episodes of a variant as ``imujoco-original/<variant>-v0``.

    Raises:
        ImujocoError: when a file is missing or is not what it must be, or the root cannot be written.
    """
    member, dataset_id = archive.member(variant, "dataset"), variant.dataset_id(EXPERT)
    with member.on_disk() as path:
        origin = {"source": f"dataset/{member.name}", "source_sha256": file_format.file_sha256(path)}
        if published := find_published(dataset_id, origin, force=how.force):
            return published
        arrays = read_npz(path)
    source, mjcf = archive.mjcf(variant)
    if ARRAY not in arrays:
        raise DatasetError(f"{member}: holds no array {ARRAY!r}, but {', '.join(sorted(arrays))[:200]}")
    transitions, layout, checks = read_table(arrays[ARRAY], variant.robot, str(member), how.columns)
    spec, rebuilt = environment_spec(variant, mjcf), REBUILT in source
    with Physics(spec) as physics:
        found = cut(transitions, physics)
        made, model = _origin("data", variant, rebuilt)
        by = "" if rebuilt else ", made by its authors with gym's v3 environments and mujoco-py"
        description = (
            f"{made}: {len(found.bounds)} episodes, {len(transitions)} steps{by}. "
            f"Read as the columns {layout}. No seeds are known, so the episodes cannot be replayed. "
            f"The environment is the {model} model under Gymnasium's v5 rules and today's MuJoCo."
        )
        metadata = {
            **_metadata(variant, spec, "unknown" if rebuilt else "SAC", source),
            "description": " ".join((description, *found.notes)),
            **_reference_maximum(found),
            **origin,
            "source_columns": str(layout),
            "source_checks": [str(check) for check in checks],
            "one_step_difference": vars(found.fidelity()),
        }
        attributes = file_format.attributes(variant, EXPERT) | {CATALOGUE: ORIGINAL}
        attributes[file_format.REPLAYABLE] = False
        dataset = NewDataset(dataset_id, attributes, mjcf, metadata)
        return publish_episodes(dataset, spec, found.episodes(), force=how.force)


def recollect(archive: Archive, variant: OriginalVariant, how: Import) -> Published:
    """Roll the archive's policy out in the archive's model and publish it as the tier ``recollected``.

    Raises:
        ImujocoError: when a file is missing or is not what it must be, or the root cannot be written.
    """
    member, dataset_id = archive.member(variant, "policies"), variant.dataset_id(RECOLLECTED)
    with member.on_disk() as path:
        origin = {
            "source": f"policies/{member.name}",
            "source_sha256": file_format.file_sha256(path),
            "seed": how.seed,
        }
        asked = {**origin, "total_episodes": how.episodes}
        if published := find_published(dataset_id, asked, force=how.force):
            return published
        policy = read_actor(path).for_robot(variant.robot)
    source, mjcf = archive.mjcf(variant)
    spec, rebuilt = environment_spec(variant, mjcf), REBUILT in source
    made, model = _origin("policy", variant, rebuilt)
    older = "" if rebuilt else " The original's own episodes were made with gym's v3 environments."
    description = (
        f"{made}, rolled out deterministically for {how.episodes} episodes in the {model} model under "
        f"Gymnasium's v5 rules and MuJoCo {version('mujoco')}.{older}"
    )
    metadata = {
        **_metadata(variant, spec, policy.algorithm, source),
        "description": description,
        **origin,
        "policy_sha256": policy.sha256,
        "policy_deterministic": policy.deterministic,
    }
    attributes = file_format.attributes(variant, RECOLLECTED) | {CATALOGUE: ORIGINAL}
    dataset = NewDataset(dataset_id, attributes, mjcf, metadata)

    def write(data: Path) -> None:
        collect(spec, policy, range(how.episodes), how.seed, data, lambda seed: attributes)

    return publish_written(dataset, write, asked, force=how.force)


def _origin(what: str, variant: OriginalVariant, rebuilt: bool) -> tuple[str, str]:
    """Return words for where the data or the policy of a variant come from, and for the archive's model."""
    if rebuilt:
        return f"The iMuJoCo {what} of {variant}, rebuilt, from {REBUILT_SOURCE}", "archived"
    return f"The original iMuJoCo {what} of {variant}, from {SOURCE}", "original"


def _metadata(variant: OriginalVariant, spec: EnvSpec, algorithm: str, source: str) -> dict[str, Any]:
    """Return the metadata that imported and recollected datasets share, except for their descriptions."""
    with closing(gym.make(spec)) as env:
        random = evaluate(env, random_policy(variant.robot), episodes=REFERENCE_EPISODES)
    by = {} if REBUILT in source else {"author": sorted(AUTHORS), "code_permalink": CODE}
    return {
        **provenance(algorithm=algorithm, description=""),
        **by,
        "license": "Apache-2.0",
        "mjcf_source": source,
        "ref_min_score": random.return_mean,
        "num_episodes_average_score": random.episodes,
        "ref_min_evaluation": random.asdict(),
    }


def _reference_maximum(found: Cut) -> dict[str, Any]:
    """Return the archive's own mean return as the score of its expert, where the archive has rewards."""
    rewards = found.transitions.rewards
    if rewards is None:
        return {}
    returns = [float(rewards[start:stop].sum()) for start, stop in found.bounds]
    statistics = {"return_mean": float(np.mean(returns)), "return_std": float(np.std(returns))}
    own = {"episodes": len(returns), **statistics, "source": "this dataset's own episodes"}
    return {"ref_max_score": statistics["return_mean"], "ref_max_evaluation": own}
