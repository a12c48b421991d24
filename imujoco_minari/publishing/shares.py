"""Records a recipe's episodes in shares, in one process or several, and joins the shares in order."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.envs.registration import environment_spec, randomised_spec
from imujoco_minari.errors import JobError
from imujoco_minari.parallel import run_jobs
from imujoco_minari.policies.tiers import TierPart
from imujoco_minari.publishing.collector import OnEpisode, collect
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.storage import copying, file_format
from imujoco_minari.storage.containment import LinkedFiles
from imujoco_minari.storage.quiet_file import writing
from imujoco_minari.variants import Ranges


@dataclass(frozen=True)
class _Share:
    """Some episodes of one part of a dataset that one process records in a folder."""

    part: TierPart
    episodes: Sequence[int]
    folder: Path


def record_shares(
    recipe: Recipe, made_by: Sequence[TierPart], data: Path, jobs: int, on_episode: OnEpisode
) -> None:
    """Record a recipe's episodes in shares and join them, in order, in the new folder ``data``.

    Raises:
        JobError: if a share is lost with its process.
    """
    shares = list(_divide(made_by, data, jobs))
    if jobs == 1:
        for share in shares:
            _record_share(recipe, share, on_episode)
    else:
        for number, outcome in run_jobs(partial(_record_share, recipe), shares, jobs=jobs):
            if isinstance(outcome, JobError):
                raise outcome
            for _ in shares[number].episodes:
                on_episode()
    _join_shares([share.folder for share in shares], data)


def _divide(made_by: Sequence[TierPart], data: Path, jobs: int) -> Iterator[_Share]:
    """Divide the episodes: one share per part for one job, about four shares per job for several."""
    first = number = 0
    for part in made_by:
        wanted = 1 if jobs == 1 else -(-4 * jobs // len(made_by))
        for episodes in np.array_split(np.arange(part.episodes) + first, min(wanted, part.episodes)):
            yield _Share(part, episodes.tolist(), data.with_name(f"share-{number}"))
            number += 1
        first += part.episodes


def _record_share(recipe: Recipe, share: _Share, on_episode: OnEpisode = lambda: None) -> None:
    # A worker that was lost may have left something.
    shutil.rmtree(share.folder, ignore_errors=True)
    variant = recipe.variant
    spec = randomised_spec(variant) if isinstance(variant, Ranges) else environment_spec(variant)

    def attributes(seed: int) -> dict[str, Any]:
        return recipe.episode_attributes(seed) | dict(share.part.attributes)

    collect(spec, share.part.policy, share.episodes, recipe.seed, share.folder, attributes, on_episode)


def _join_shares(folders: Sequence[Path], data: Path) -> None:
    """Append the episodes of all folders to the first, in order, and rename it to ``data``."""
    first, *others = folders
    with writing(file_format.main_file(first)) as target:
        for other in others:
            with LinkedFiles(file_format.main_file(other)) as source:
                copying.copy_episodes(source, range(len(source.file)), target, "")
            shutil.rmtree(other)
    first.rename(data)
