"""From a recipe to a published Minari dataset: roll out, complete, verify, commit.

The only writer of datasets. All happens in a staging folder of the Minari root; what is committed is
whole and has been checked, and what is interrupted was never visible.
"""

from __future__ import annotations

import platform
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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

from imujoco_minari import content, copying, roots
from imujoco_minari.collection import collect
from imujoco_minari.errors import DatasetError, DatasetExistsError, ImujocoError, JobError
from imujoco_minari.mjcf import canonical_mjcf, mjcf_sha256
from imujoco_minari.parallel import run_jobs
from imujoco_minari.policies import Policy
from imujoco_minari.recording import EpisodeStorage
from imujoco_minari.references import reference_scores
from imujoco_minari.tiers import Part, parts
from imujoco_minari.variants import EXPERT, Variant
from imujoco_minari.verification import inspect
from imujoco_minari.writing import writing

Progress = Callable[[], None]


@dataclass(frozen=True)
class Recipe:
    """All that decides the content of a dataset, beside the versions of the software.

    Attributes:
        variant: whose environment is stepped.
        tier: which policy makes the data; part of the dataset's id.
        episodes: how many.
        seed: base seed of all that is random.
        policy: a policy file to use instead of the shipped one.
        stochastic: sample the actions instead of taking the policy's mode.
    """

    variant: Variant
    tier: str = EXPERT
    episodes: int = 100
    seed: int = 0
    policy: Path | None = None
    stochastic: bool = False

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise DatasetError(f"a dataset has at least one episode, not {self.episodes}")
        if self.seed < 0:
            raise DatasetError(f"a seed is not negative, as {self.seed} is")

    @property
    def dataset_id(self) -> str:
        """The id under which the dataset is published."""
        return self.variant.dataset_id(self.tier)

    @property
    def attributes(self) -> dict[str, Any]:
        """What the dataset's root and each of its episodes carry."""
        return content.attributes(self.variant, self.tier)

    @property
    def episode_attributes(self) -> dict[str, Any]:
        """What each episode carries: whence it came too, which a collection of it then says."""
        return self.attributes | {"source": self.dataset_id}

    def parts(self) -> list[Part]:
        """Return the policies that make the dataset, and how many episodes each."""
        return parts(self.variant, self.tier, self.episodes, path=self.policy, stochastic=self.stochastic)


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
    if roots.taken(recipe.dataset_id) and not force:
        return _summary(recipe.dataset_id, created=False)
    start = time.monotonic()
    made_by = recipe.parts()
    with roots.staging(recipe.dataset_id) as folder:
        staged = folder / "dataset"
        staged.mkdir()
        data = staged / "data"
        _roll_out(recipe, made_by, data, jobs, on_episode)
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
    if roots.taken(dataset_id) and not force:
        return _summary(dataset_id, created=False)
    start = time.monotonic()
    with roots.staging(dataset_id) as folder:
        staged = folder / "dataset"
        data = staged / "data"
        data.mkdir(parents=True)
        stock = MinariStorage.new(data, env_spec=external.env_spec)
        storage = EpisodeStorage(data, stock.observation_space, stock.action_space)
        storage.attributes = external.attributes
        storage.update_episodes(episodes)
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
    content.seal_files(staged / "data")
    findings = inspect(staged / "data", replay_episodes=1)
    if findings:
        raise DatasetError(f"{dataset_id}: not published, its check found: {findings[0]}")
    try:
        roots.commit(staged, dataset_id, replace=force)
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


@dataclass(frozen=True)
class _Share:
    """Episodes of one part of a dataset that are recorded in one go, in a folder."""

    part: Part
    episodes: Sequence[int]
    folder: Path


def _roll_out(
    recipe: Recipe, made_by: Sequence[Part], data: Path, jobs: int, on_episode: Progress | None
) -> None:
    """Record the recipe's episodes in ``data``, in shares that are joined in order."""
    shares = list(_shares(made_by, data, jobs))
    if jobs == 1:
        for share in shares:
            _record(recipe, share, on_episode)
    else:
        for number, outcome in run_jobs(partial(_record, recipe), shares, jobs=jobs):
            if isinstance(outcome, JobError):
                raise outcome
            for _ in shares[number].episodes:
                if on_episode is not None:
                    on_episode()
    _join([share.folder for share in shares], data)


def _shares(made_by: Sequence[Part], data: Path, jobs: int) -> Iterator[_Share]:
    """Divide the episodes: one share a part with one job, about four a job with several."""
    first = number = 0
    for part in made_by:
        wanted = 1 if jobs == 1 else -(-4 * jobs // len(made_by))
        for episodes in np.array_split(np.arange(part.episodes) + first, min(wanted, part.episodes)):
            yield _Share(part, episodes.tolist(), data.with_name(f"share-{number}"))
            number += 1
        first += part.episodes


def _record(recipe: Recipe, share: _Share, on_episode: Progress | None = None) -> None:
    """Record a share, in the place of what a lost worker left in its folder."""
    shutil.rmtree(share.folder, ignore_errors=True)
    attributes = {**recipe.episode_attributes, **share.part.attributes}
    collect(
        recipe.variant, share.part.policy, share.episodes, recipe.seed, share.folder, attributes, on_episode
    )


def _join(folders: Sequence[Path], data: Path) -> None:
    """Move the episodes of all folders, in order, behind those of the first, which becomes ``data``."""
    first, *others = folders
    if not others:
        first.rename(data)
        return
    storage = MinariStorage.read(first)
    steps = storage.total_steps
    with writing(content.main_file(first)) as target:
        for other in others:
            with h5py.File(content.main_file(other), "r") as source:
                steps += copying.copy_episodes(source, range(len(source)), target, "").steps
            shutil.rmtree(other)
        episodes = len(target)
    storage.update_metadata({"total_episodes": episodes, "total_steps": steps})
    first.rename(data)


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
            "algorithm_name": _algorithms(policies),
            "author": {"imujoco_minari"},
            "code_permalink": f"imujoco-minari=={version('imujoco-minari')}",
            "description": _description(recipe, policies),
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
    with writing(content.main_file(storage.data_path)) as file:
        digests = {
            "mjcf_sha256": mjcf_sha256(mjcf),
            "content_sha256": content.content_sha256(file, len(file)),
        }
        file.attrs.update({**attributes, "mjcf": mjcf, **digests})
    return {**attributes, **digests}


def _algorithms(policies: Sequence[Policy]) -> str:
    return ", ".join(dict.fromkeys(policy.algorithm for policy in policies))


def _description(recipe: Recipe, policies: Sequence[Policy]) -> str:
    variant = recipe.variant
    change = (
        "unchanged"
        if not variant.body
        else f"with the {variant.category} of {', '.join(variant.mjcf_names)} "
        f"changed by {variant.percent:+d} %"
    )
    return (
        f"iMuJoCo, rebuilt: the robot {variant.robot} of Gymnasium's v5 environments, {change}. "
        f"{recipe.episodes} episodes of the tier {recipe.tier}, by {len(policies)} "
        f"{'policy' if len(policies) == 1 else 'policies'} ({_algorithms(policies)}) acting "
        f"{'deterministically' if all(policy.deterministic for policy in policies) else 'stochastically'}."
    )


def _summary(dataset_id: str, *, created: bool, seconds: float = 0.0) -> Published:
    path = roots.dataset_folder(dataset_id)
    try:
        with h5py.File(content.main_file(path / "data"), "r") as file:
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
