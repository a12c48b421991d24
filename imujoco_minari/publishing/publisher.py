"""From a recipe to a published Minari dataset: roll out, complete, verify, commit.

The only writer of datasets. All happens in a staging folder of the Minari root; what is committed is
whole and has been checked, and what is interrupted was never visible.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from gymnasium.envs.registration import EnvSpec
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

from imujoco_minari.envs.mjcf import canonical_mjcf, mjcf_sha256
from imujoco_minari.errors import DatasetError, DatasetExistsError, ImujocoError, JobError
from imujoco_minari.parallel import run_jobs
from imujoco_minari.policies.references import reference_scores
from imujoco_minari.policies.tiers import Part
from imujoco_minari.publishing.recipes import Recipe, algorithms, description
from imujoco_minari.publishing.shares import Progress, record_shares
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.storage.quiet_file import writing
from imujoco_minari.storage.writer import EpisodeStorage
from imujoco_minari.variants import Variant
from imujoco_minari.verification import inspect


@dataclass(frozen=True)
class Published:
    """What became of one recipe.

    Attributes:
        dataset_id: the dataset's id.
        path: its folder; None when it failed.
        created: whether this call made it; False when it was there already.
        episodes: number of episodes.
        steps: number of steps.
        return_mean: mean undiscounted return of the episodes.
        return_std: their standard deviation.
        content_sha256: digest of the arrays.
        seconds: wall time.
        error: why it failed; empty when it did not.
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


def publish(
    variant: Variant | str | Recipe,
    *,
    jobs: int = 1,
    force: bool = False,
    on_episode: Progress | None = None,
    **options: Any,
) -> Published:
    """Publish one variant's dataset into the Minari root.

    Args:
        variant: a variant, its id, or a whole :class:`Recipe`.
        jobs: how many processes roll the episodes out; the content does not depend on it.
        force: replace a dataset that has the id; the old one stands until the new one is whole.
        on_episode: called after each episode (each share of the episodes, with several jobs).
        **options: the other fields of :class:`Recipe`.

    Returns:
        What was made, or, with ``created`` false, the dataset that has the id already.

    Raises:
        ImujocoError: when the policy cannot be had, the root not written, or the check fails.
    """
    if not isinstance(variant, Recipe):
        variant = Recipe(Variant.parse(variant) if isinstance(variant, str) else variant, **options)
    recipe = variant
    if minari_root.taken(recipe.dataset_id) and not force:
        return _summary(recipe.dataset_id, created=False)
    start = time.monotonic()
    made_by = recipe.parts()
    with minari_root.staging(recipe.dataset_id) as folder:
        staged = folder / "dataset"
        staged.mkdir()
        data = staged / "data"
        record_shares(recipe, made_by, data, jobs, on_episode)
        _complete(recipe, made_by, data)
        created = _commit(staged, recipe.dataset_id, force)
    return _summary(recipe.dataset_id, created=created, seconds=time.monotonic() - start)


@dataclass(frozen=True)
class External:
    """What identifies a dataset whose episodes were not rolled out from a recipe.

    Attributes:
        dataset_id: the id under which it is published.
        attributes: what the root and every episode carry, :func:`content.attributes` among them.
        env_spec: the environment that the dataset recovers.
        mjcf: the MJCF text that this environment runs.
        metadata: what ``metadata.json`` says beyond what follows from the episodes.
    """

    dataset_id: str
    attributes: Mapping[str, Any]
    env_spec: EnvSpec
    mjcf: str
    metadata: Mapping[str, Any]


def publish_episodes(
    external: External, episodes: Iterable[EpisodeBuffer], *, force: bool = False
) -> Published:
    """Publish episodes that were made elsewhere; staged, checked and committed as any other dataset.

    Raises:
        ImujocoError: when the root cannot be written, or the check of the staged dataset fails.
    """
    dataset_id = external.dataset_id
    if minari_root.taken(dataset_id) and not force:
        return _summary(dataset_id, created=False)
    start = time.monotonic()
    with minari_root.staging(dataset_id) as folder:
        staged = folder / "dataset"
        data = staged / "data"
        data.mkdir(parents=True)
        stock = MinariStorage.new(data, env_spec=external.env_spec)
        storage = EpisodeStorage(data, stock.observation_space, stock.action_space)
        storage.attributes = external.attributes
        try:
            storage.update_episodes(episodes)
        finally:
            storage.flush()
        storage.update_metadata(
            _seal(storage, external.attributes, external.mjcf)
            | {"dataset_id": dataset_id, "minari_version": version("minari")}
            | {**external.metadata, "dataset_size": storage.get_size()}
        )
        created = _commit(staged, dataset_id, force)
    return _summary(dataset_id, created=created, seconds=time.monotonic() - start)


def _commit(staged: Path, dataset_id: str, force: bool) -> bool:
    """Seal, check and commit a staged dataset; return False when another publisher of the id was faster."""
    file_format.seal_files(staged / "data")
    findings = inspect(staged / "data", replay_episodes=1)
    if findings:
        raise DatasetError(f"{dataset_id}: not published, its check found: {findings[0]}")
    try:
        minari_root.commit(staged, dataset_id, replace=force)
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
    """Publish many datasets and yield each outcome as it comes, failures included.

    Args:
        recipes: what to publish; their order is kept with one job.
        jobs: how many are worked on at once, each in a process of its own.
        force: replace datasets that have the ids.
        backend: where; see :func:`imujoco_minari.parallel.run_jobs`.

    Raises:
        JobError: when the back end cannot be used.
    """
    work = partial(_attempt, force=force)
    for number, outcome in run_jobs(work, recipes, jobs=jobs, backend=backend):
        if isinstance(outcome, JobError):
            outcome = Published(recipes[number].dataset_id, error=str(outcome))
        yield outcome


def _attempt(recipe: Recipe, force: bool) -> Published:
    try:
        return publish(recipe, force=force)
    except ImujocoError as error:
        return Published(recipe.dataset_id, error=str(error))


def _complete(recipe: Recipe, made_by: Sequence[Part], data: Path) -> None:
    """Add what the collector did not record: the root's attributes and digests, and the metadata."""
    policies = [part.policy for part in made_by]
    storage = MinariStorage.read(data)
    storage.update_metadata(
        _seal(storage, recipe.attributes, canonical_mjcf(recipe.variant))
        | reference_scores(recipe.variant)
        | {
            "dataset_id": recipe.dataset_id,
            "minari_version": version("minari"),
            "algorithm_name": algorithms(policies),
            "author": {"imujoco_minari"},
            "code_permalink": f"imujoco-minari=={version('imujoco-minari')}",
            "description": description(recipe, policies),
            "requirements": [f"{name}=={version(name)}" for name in ("mujoco", "gymnasium")],
            "policy_sha256": ",".join(policy.sha256 for policy in policies),
            "policy_deterministic": all(policy.deterministic for policy in policies),
            "seed": recipe.seed,
            "versions": {
                name: version(name) for name in ("imujoco-minari", "mujoco", "gymnasium", "minari", "numpy")
            },
            "machine": platform.machine(),
            # With these BLAS and the C library calculate otherwise, in the last bit, than without.
            "simd": np.show_config(mode="dicts")["SIMD Extensions"]["found"],
            "dataset_size": storage.get_size(),
        }
    )


def _seal(storage: MinariStorage, attributes: Mapping[str, Any], mjcf: str) -> dict[str, Any]:
    """Write attributes and digests to the HDF5 file's root; return them as the metadata repeats them."""
    with writing(file_format.main_file(storage.data_path)) as file:
        digests = {
            "mjcf_sha256": mjcf_sha256(mjcf),
            "content_sha256": file_format.content_sha256(file, len(file)),
        }
        file.attrs.update({**attributes, "mjcf": mjcf, **digests})
    return {**attributes, **digests}


def _summary(dataset_id: str, *, created: bool, seconds: float = 0.0) -> Published:
    path = minari_root.dataset_folder(dataset_id)
    try:
        with h5py.File(file_format.main_file(path / "data"), "r") as file:
            returns = [file[name].attrs["rewards_sum"] for name in file]
            steps = sum(int(file[name].attrs["total_steps"]) for name in file)
            digest = str(file.attrs.get("content_sha256", ""))
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise DatasetError(
            f"{dataset_id}: there is something at {path}, but no whole dataset of ours: {error}"
        ) from None
    return Published(
        dataset_id,
        path,
        created,
        len(returns),
        steps,
        float(np.mean(returns)),
        float(np.std(returns)),
        digest,
        seconds,
    )
