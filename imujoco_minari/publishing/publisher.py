"""From a recipe to a published Minari dataset: roll out, complete, check, commit.

A dataset is made in a staging folder of the Minari root and committed after it was checked. An interrupted
publication is never visible.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
from gymnasium.envs.registration import EnvSpec
from minari.data_collector import EpisodeBuffer

from imujoco_minari.arguments import whole_number
from imujoco_minari.envs.mjcf import canonical_mjcf, mjcf_sha256
from imujoco_minari.errors import (
    ArgumentError,
    DatasetError,
    DatasetExistsError,
    ImujocoError,
    JobError,
    clipped,
)
from imujoco_minari.parallel import run_jobs
from imujoco_minari.policies import Policy
from imujoco_minari.policies.references import reference_scores
from imujoco_minari.policies.tiers import MEDIUM_REPLAY
from imujoco_minari.publishing.recipes import Recipe, algorithms, description
from imujoco_minari.publishing.shares import OnEpisode, record_shares
from imujoco_minari.storage import file_format, minari_root, transactions
from imujoco_minari.storage.metadata import complete_metadata, provenance, read_metadata
from imujoco_minari.storage.quiet_file import writing
from imujoco_minari.storage.writer import new_storage
from imujoco_minari.variants import EXPERT, Ranges, Variant
from imujoco_minari.verification import inspect


@dataclass(frozen=True)
class Published:
    """The outcome of publishing one dataset.

    Attributes:
        dataset_id: the dataset's id.
        path: folder of the dataset; None if the publication failed.
        created: whether this call made it; False if it existed already.
        episodes: number of episodes.
        steps: number of steps.
        return_mean: mean undiscounted return of the episodes.
        return_std: standard deviation of the returns.
        content_sha256: digest of the arrays.
        seconds: wall time.
        error: why the publication failed; empty on success.
        missing: whether it failed because something that was asked for does not exist.
    """

    dataset_id: str
    path: Path | None = None
    created: bool = False
    episodes: int = 0
    steps: int = 0
    return_mean: float = float("nan")
    return_std: float = float("nan")
    content_sha256: str = ""
    seconds: float = 0.0
    error: str = ""
    missing: bool = False


def publish(
    variant: Variant | str | Ranges,
    *,
    tier: str = EXPERT,
    episodes: int = 100,
    seed: int = 0,
    policy: Path | str | Policy | None = None,
    jobs: int = 1,
    force: bool = False,
) -> Published:
    """Publish one variant's dataset in the Minari root.

    Args:
        variant: a variant or its id; or :class:`~imujoco_minari.variants.ranges.Ranges`, from which each
            episode draws a variant.
        tier: the tier, which names the policy and is part of the dataset's id.
        episodes: number of episodes.
        seed: base seed of all random numbers.
        policy: a file, or a policy of :func:`load_policy`, to use instead of the tier's.
        jobs: number of processes. The content does not depend on it.
        force: replace the dataset that has the id. The old dataset is removed when the new one is complete.

    Returns:
        The outcome. ``created`` is false if the root has the dataset of the same recipe already.

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
    parsed = variant if isinstance(variant, Ranges) else Variant.parse(variant)
    made_by = Path(policy) if isinstance(policy, str) else policy
    return publish_recipe(Recipe(parsed, tier, episodes, seed, made_by), jobs=jobs, force=force)


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
        # That module imports this one.
        from imujoco_minari.publishing.training_data import record_medium_replay

        return record_medium_replay(recipe, force=force, on_episode=on_episode)
    made_by = recipe.parts()
    stated = recipe.stated(made_by)
    if found := find_published(recipe.dataset_id, stated, force=force):
        return found
    start = time.monotonic()
    references = {} if isinstance(recipe.variant, Ranges) else reference_scores(recipe.variant)
    metadata = references | stated | {"tier": recipe.tier}
    metadata |= provenance(
        algorithm=algorithms([part.policy for part in made_by]), description=description(recipe, made_by)
    )
    with transactions.staging(recipe.dataset_id) as folder:
        staged = folder / "dataset"
        staged.mkdir()
        record_shares(recipe, made_by, staged / "data", jobs, on_episode)
        dataset = NewDataset(recipe.dataset_id, recipe.attributes, canonical_mjcf(recipe.nominal), metadata)
        created = _check_and_commit(staged, dataset, force)
    return _read_outcome(recipe.dataset_id, created=created, seconds=time.monotonic() - start)


@dataclass(frozen=True)
class NewDataset:
    """A dataset to be published, without its episodes.

    Attributes:
        dataset_id: the dataset's id.
        attributes: attributes of the file and of every episode.
        mjcf: the MJCF text of its environment.
        metadata: the entries of ``metadata.json`` that do not follow from the episodes.
    """

    dataset_id: str
    attributes: Mapping[str, Any]
    mjcf: str
    metadata: Mapping[str, Any]


def publish_episodes(
    dataset: NewDataset, spec: EnvSpec, episodes: Iterable[EpisodeBuffer], *, force: bool = False
) -> Published:
    """Publish given episodes as a dataset.

    Args:
        dataset: the dataset, without its episodes.
        spec: specification of the environment that the dataset recovers.
        episodes: the episodes, in order.
        force: replace the dataset that has the id.

    Raises:
        DatasetExistsError: if the root has another dataset with this id and ``force`` is false.
        StorageError: if the root cannot be written.
        DatasetError: if the check of the new dataset fails.
    """
    dataset_id = dataset.dataset_id
    origin = {key: dataset.metadata[key] for key in _ORIGIN_KEYS if key in dataset.metadata}
    if found := find_published(dataset_id, origin, force=force):
        return found
    start = time.monotonic()
    with transactions.staging(dataset_id) as folder:
        staged = folder / "dataset"
        staged.mkdir()
        env = gym.make(spec)
        storage = new_storage(staged / "data", env, dataset.attributes)
        env.close()
        try:
            storage.update_episodes(episodes)
        finally:
            storage.flush()
        created = _check_and_commit(staged, dataset, force)
    return _read_outcome(dataset_id, created=created, seconds=time.monotonic() - start)


# Metadata keys that identify the origin of given episodes.
_ORIGIN_KEYS = ("source", "source_sha256", "seed", "policy_sha256")


def find_published(dataset_id: str, asked: Mapping[str, Any], *, force: bool) -> Published | None:
    """Return the outcome if the root has the requested dataset already; None if it is to be made.

    Args:
        dataset_id: the dataset's id.
        asked: metadata that distinguish the requested dataset from others with the same id.
        force: replace what exists: the answer is None.

    Raises:
        DatasetExistsError: if the dataset with this id differs from the requested one.
    """
    if force or not transactions.taken(dataset_id):
        return None
    stated = read_metadata(minari_root.dataset_folder(dataset_id) / "data")
    differing = {key: value for key, value in asked.items() if stated.get(key, value) != value}
    if differing:
        has = ", ".join(_format_value(key, stated[key]) for key in differing)
        wanted = ", ".join(_format_value(key, value) for key, value in differing.items())
        raise DatasetExistsError(
            f"{dataset_id} is already published, but differs: it has {has}; you asked for {wanted}. "
            "Replace it with --force (force=True), or choose another tier"
        )
    return _read_outcome(dataset_id, created=False)


def _format_value(key: str, value: Any) -> str:
    """Return a value of the metadata as text for a message."""
    if key == "total_episodes":
        return f"{value} episodes"
    if key == "policy_deterministic":
        return "deterministic actions" if value else "sampled actions"
    return f"{key.removesuffix('_sha256')} {clipped(value)}"


def _check_and_commit(staged: Path, dataset: NewDataset, force: bool) -> bool:
    """Complete, check and commit a staged dataset; return False if another process was faster."""
    data, dataset_id = staged / "data", dataset.dataset_id
    with writing(file_format.main_file(data)) as file:
        digests = {
            "mjcf_sha256": mjcf_sha256(dataset.mjcf),
            "content_sha256": file_format.content_sha256(file, len(file)),
        }
        file.attrs.update({**dataset.attributes, "mjcf": dataset.mjcf, **digests})
        returns = [float(file[name].attrs["rewards_sum"]) for name in file]
    stated = {**dataset.metadata, **dataset.attributes, **digests, **file_format.return_statistics(returns)}
    complete_metadata(data, stated | {"dataset_id": dataset_id})
    findings = inspect(data, replay_episodes=1)
    if findings:
        raise DatasetError(f"{dataset_id}: not published, because its check found: {findings[0]}")
    try:
        transactions.commit(staged, dataset_id, replace=force)
    except DatasetExistsError:
        if force:
            raise
        return False
    return True


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
            outcome = Published(recipes[number].dataset_id, error=str(outcome))
        yield outcome


def _publish_or_report(recipe: Recipe, force: bool) -> Published:
    try:
        return publish_recipe(recipe, force=force)
    except ImujocoError as error:
        return Published(recipe.dataset_id, error=str(error), missing=error.missing)


def _read_outcome(dataset_id: str, *, created: bool, seconds: float = 0.0) -> Published:
    path = minari_root.dataset_folder(dataset_id)
    try:
        with h5py.File(file_format.main_file(path / "data"), "r") as file:
            returns = [float(file[name].attrs["rewards_sum"]) for name in file]
            steps = sum(int(file[name].attrs["total_steps"]) for name in file)
            digest = str(file.attrs.get("content_sha256", ""))
        if not returns:
            raise ValueError("it has no episodes")
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise DatasetError(
            f"{dataset_id}: {path} exists, but is not a complete dataset of this package: {error}"
        ) from None
    statistics = file_format.return_statistics(returns)
    return Published(
        dataset_id,
        path,
        created,
        episodes=len(returns),
        steps=steps,
        return_mean=statistics["return_mean"],
        return_std=statistics["return_std"],
        content_sha256=digest,
        seconds=seconds,
    )
