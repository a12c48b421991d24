"""The tiers ``replay`` and ``medium-replay``: the transitions of a training run as a dataset."""

from __future__ import annotations

import shutil
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from imujoco_minari.envs.mjcf import canonical_mjcf
from imujoco_minari.envs.registration import environment_spec
from imujoco_minari.errors import PolicyNotFoundError, TrainingError
from imujoco_minari.policies.references import measured_record, reference_scores
from imujoco_minari.policies.rungs import MEDIUM_SHARE, return_at
from imujoco_minari.policies.tiers import MEDIUM_REPLAY, REPLAY
from imujoco_minari.publishing.collector import Collector, OnEpisode
from imujoco_minari.publishing.new_dataset import NewDataset, find_published, publish_written
from imujoco_minari.publishing.outcome import Published
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.storage import file_format
from imujoco_minari.storage.metadata import provenance
from imujoco_minari.storage.writer import EpisodeWriter
from imujoco_minari.training.agents import ALGORITHM
from imujoco_minari.training.hyperparameters import SCRATCH, hyperparameters
from imujoco_minari.training.run import OnInterval, Progress, Run, do_nothing
from imujoco_minari.training.task import Task


def record_medium_replay(
    recipe: Recipe, *, force: bool = False, on_episode: OnEpisode = lambda: None
) -> Published:
    """Train on a variant from scratch up to the return of ``medium``, and publish the whole episodes.

    The run ends at the first actor whose score, the mean of the mean and the lowest return of 100 episodes,
    reaches 0.42 of the expert's return. It always computes on the CPU, because a GPU rounds otherwise. The
    same seed gives the same dataset, bit for bit, on one kind of processor with the same versions.

    Args:
        recipe: a recipe of the tier. Its seed is that of the run.
        force: replace the dataset that has the id.
        on_episode: called after each whole episode.

    Raises:
        DatasetError: if the check of the new dataset fails.
        DatasetExistsError: if the root has another dataset with this id and ``force`` is false.
        PolicyNotFoundError: if the variant has no expert to compare with.
        TrainingError: if the run does not reach the return.
    """
    variant = recipe.nominal
    expert = measured_record(variant)
    if not expert:
        raise PolicyNotFoundError(
            f"{MEDIUM_REPLAY} ends at {MEDIUM_SHARE} of the expert's return, and {variant} has no expert: "
            f"train one with `imujoco train {variant}`"
        )
    target = return_at(MEDIUM_SHARE, expert)
    task = Task(variant, hyperparameters(variant.robot, SCRATCH), recipe.seed, target=target)
    with TemporaryDirectory(prefix="imujoco-") as folder:
        return record_training(
            task, Path(folder) / "run", MEDIUM_REPLAY, device="cpu", force=force, on_episode=on_episode
        )


def record_training(
    task: Task,
    folder: Path,
    tier: str = REPLAY,
    *,
    device: str | None = None,
    force: bool = False,
    on_interval: OnInterval = do_nothing,
    on_episode: OnEpisode = lambda: None,
) -> Published:
    """Train a task to its end and publish its whole episodes as a tier of the variant.

    A killed run must start again, because its transitions are stored nowhere else. The policy is not
    installed.

    Args:
        task: the training run.
        folder: state of the run. Its present content is removed.
        tier: the tier of the dataset.
        device: see :func:`~imujoco_minari.training.agents.make_agent`.
        force: replace the dataset that has the id.
        on_interval: called with the progress and the task after every interval.
        on_episode: called after each whole episode.

    Raises:
        DatasetExistsError: if the root has another dataset with this id and ``force`` is false.
        DatasetError: if the check of the new dataset fails.
        TrainingError: if the task has a target and does not reach it.
    """
    dataset_id = task.variant.dataset_id(tier)
    # One lane, so that the episodes are in the order of the run.
    task = replace(task, settings=replace(task.settings, lanes=1))
    asked = {"seed": task.seed, "hyperparameters": task.settings.asdict()}
    if found := find_published(dataset_id, asked, force=force):
        return found
    start = time.monotonic()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    recorded = folder / "recorded"
    attributes = file_format.attributes(task.variant, tier) | {"source": dataset_id}
    with EpisodeWriter(recorded, environment_spec(task.variant), lambda seed: attributes) as writer:
        run = Run(task, folder, lambda env: Collector(env, writer, on_episode), device)
        with closing(run):
            run.train(on_interval)
    if run.progress.best_score < task.target < float("inf"):
        raise TrainingError(
            f"{dataset_id}: the run has reached a return of {run.progress.best_score:.0f} in "
            f"{run.progress.steps} steps, not {task.target:.0f}; another seed (--seed) may reach it"
        )
    metadata = _dataset_metadata(task, run.progress) | asked
    dataset = NewDataset(dataset_id, attributes, canonical_mjcf(task.variant), metadata)
    published = publish_written(dataset, lambda data: shutil.move(recorded, data), asked, force=force)
    shutil.rmtree(folder)
    return replace(published, seconds=time.monotonic() - start)


def _dataset_metadata(task: Task, progress: Progress) -> dict[str, Any]:
    end = "" if task.target == float("inf") else f", up to a return of {task.target:.0f}"
    return {
        **reference_scores(task.variant),
        **provenance(
            algorithm=ALGORITHM,
            description=(
                f"iMuJoCo, rebuilt: the transitions of a training run of {ALGORITHM} on {task.variant}, "
                f"{progress.steps} steps from {task.start.name}{end}, in the order of the run. "
                "Episodes that an evaluation cut short are left out."
            ),
        ),
        "policy_deterministic": False,
    }
