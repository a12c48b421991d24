"""From recipes to published Minari datasets, one or many."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import overload

from imujoco_minari.envs.mjcf import canonical_mjcf
from imujoco_minari.errors import (
    ArgumentError,
    DatasetError,
    ImujocoError,
    JobError,
    PolicyWarning,
    whole_number,
)
from imujoco_minari.parallel import run_jobs
from imujoco_minari.policies import Policy
from imujoco_minari.policies.references import reference_scores, weakness_of
from imujoco_minari.policies.tiers import MEDIUM_REPLAY
from imujoco_minari.publishing.collector import OnEpisode
from imujoco_minari.publishing.new_dataset import NewDataset, find_published, publish_written
from imujoco_minari.publishing.outcome import Published
from imujoco_minari.publishing.recipes import Recipe, algorithms, description
from imujoco_minari.publishing.shares import record_shares
from imujoco_minari.publishing.sizes import check_space, expected_bytes
from imujoco_minari.publishing.training_data import record_medium_replay
from imujoco_minari.storage.metadata import provenance
from imujoco_minari.variants import EXPERT, Ranges, Variant


@overload
def publish(  # type: ignore[overload-overlap]  # a str is an iterable of str
    variant: Variant | str | Ranges,
    *,
    tier: str = ...,
    episodes: int = ...,
    seed: int = ...,
    policy: Path | str | Policy | None = ...,
    jobs: int = ...,
    force: bool = ...,
) -> Published: ...


@overload
def publish(
    variant: Iterable[Variant | str | Ranges],
    *,
    tier: str = ...,
    episodes: int = ...,
    seed: int = ...,
    policy: Path | str | Policy | None = ...,
    jobs: int = ...,
    force: bool = ...,
) -> list[Published]: ...


def publish(
    variant: Variant | str | Ranges | Iterable[Variant | str | Ranges],
    *,
    tier: str = EXPERT,
    episodes: int = 100,
    seed: int = 0,
    policy: Path | str | Policy | None = None,
    jobs: int = 1,
    force: bool = False,
) -> Published | list[Published]:
    """Publish one variant's dataset in the Minari root, or the datasets of several.

    Args:
        variant: a variant or its id; or :class:`~imujoco_minari.variants.ranges.Ranges`, from which each
            episode draws a variant; or several of them.
        tier: the tier, which names the policy and is part of the dataset's id.
        episodes: number of episodes.
        seed: base seed of all random numbers.
        policy: a file, or a policy of :func:`load_policy`, to use instead of the tier's.
        jobs: number of processes. The content does not depend on it.
        force: replace the dataset that has the id. The old dataset is removed when the new one is complete.

    Returns:
        The outcome. ``created`` is false if the root has the dataset of the same recipe already. For several
        variants, a list in their order. The first failure is raised when all others are published.

    Raises:
        DatasetExistsError: if the root has another dataset with this id and ``force`` is false.
        PolicyNotFoundError: if there is no policy for the variant and the tier.
        PolicyError: if the policy does not fit, or does not state what a dataset states of its policy.
        StorageError: if the root cannot be written.
        DatasetError: if the check of the new dataset fails.
        VariantError: if there is no such variant, or the tier is malformed.
        ArgumentError: if another argument is not valid.
        TrainingError: if the run of the tier ``medium-replay`` does not reach its return.

    Example:
        >>> published = publish("hopper-massdec_25_leggeom", tier="random", episodes=5)
        >>> published.dataset_id
        'imujoco/hopper-massdec_25_leggeom-random-v0'
    """
    made_by = Path(policy) if isinstance(policy, str) else policy

    def recipe(each: Variant | str | Ranges) -> Recipe:
        parsed = each if isinstance(each, Ranges) else Variant.parse(each)
        return Recipe(parsed, tier, episodes, seed, made_by)

    if isinstance(variant, Variant | str | Ranges) or not isinstance(variant, Iterable):
        return publish_recipe(recipe(variant), jobs=jobs, force=force)
    recipes = [recipe(each) for each in variant]
    outcomes = {each.dataset_id: each for each in publish_all(recipes, jobs=jobs, force=force)}
    if failed := [each for each in outcomes.values() if each.error]:
        name, error = failed[0].dataset_id, failed[0].error
        raise DatasetError(error if name in error else f"{name}: {error}")
    return [outcomes[each.dataset_id] for each in recipes]


def publish_recipe(
    recipe: Recipe, *, jobs: int = 1, force: bool = False, on_episode: OnEpisode = lambda: None
) -> Published:
    """Publish the dataset of a recipe in the Minari root.

    Args:
        recipe: everything that decides the content.
        jobs: number of processes.
        force: replace the dataset that has the id.
        on_episode: called after each episode, with several jobs for all episodes of a share at once.

    Returns:
        As :func:`publish`.

    Raises:
        ImujocoError: what :func:`publish` raises.
    """
    whole_number(jobs, "jobs", least=1)
    if recipe.tier == MEDIUM_REPLAY:
        return record_medium_replay(recipe, force=force, on_episode=on_episode)
    made_by = recipe.parts()
    stated = recipe.stated(made_by)
    if found := find_published(recipe.dataset_id, stated, force=force):
        return found
    check_space(recipe.dataset_id, expected_bytes(recipe))
    start = time.monotonic()
    references = {} if isinstance(recipe.variant, Ranges) else reference_scores(recipe.variant)
    told = recipe.told(made_by)
    if told and (weakness := weakness_of(recipe.nominal)):
        warnings.warn(weakness, PolicyWarning, stacklevel=2)
    metadata = references | stated | told | {"tier": recipe.tier}
    metadata |= provenance(
        algorithm=algorithms([part.policy for part in made_by]), description=description(recipe, made_by)
    )
    dataset = NewDataset(recipe.dataset_id, recipe.attributes, canonical_mjcf(recipe.nominal), metadata)
    made = publish_written(
        dataset, lambda data: record_shares(recipe, made_by, data, jobs, on_episode), stated, force=force
    )
    return replace(made, seconds=time.monotonic() - start)


def publish_all(
    recipes: Sequence[Recipe],
    *,
    jobs: int = 1,
    force: bool = False,
    backend: str | None = None,
) -> Iterator[Published]:
    """Publish many datasets and yield each outcome when it is ready, failures included.

    Args:
        recipes: the recipes. One job publishes them in this order.
        jobs: number of processes. Each publishes one dataset at a time.
        force: replace the datasets that have the ids.
        backend: see :func:`imujoco_minari.parallel.run_jobs`.

    Raises:
        JobError: if the back end cannot be used.
        ArgumentError: if one of ``recipes`` is something else, or ``jobs`` is not valid.
    """
    if not all(isinstance(recipe, Recipe) for recipe in recipes):
        raise ArgumentError("publish_all() takes recipes, as in Recipe(Variant.parse('hopper-base'))")
    work = partial(_publish_or_report, force=force)
    for number, outcome in run_jobs(work, recipes, jobs=jobs, backend=backend):
        if isinstance(outcome, JobError):
            outcome = Published.failed(recipes[number].dataset_id, outcome)
        yield outcome


def _publish_or_report(recipe: Recipe, force: bool) -> Published:
    try:
        return publish_recipe(recipe, force=force)
    except ImujocoError as error:
        return Published.failed(recipe.dataset_id, error)
