"""The tier ``replay``: records the transitions of a training run and publishes them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

from imujoco_minari.envs.mjcf import canonical_mjcf
from imujoco_minari.envs.registration import environment_spec
from imujoco_minari.policies.references import reference_scores
from imujoco_minari.policies.tiers import REPLAY
from imujoco_minari.publishing.collector import StorageCollector
from imujoco_minari.publishing.publisher import NewDataset, Published, publish_episodes
from imujoco_minari.storage import file_format
from imujoco_minari.storage.metadata import provenance
from imujoco_minari.storage.writer import EpisodeStorage, new_storage
from imujoco_minari.training.run import OnInterval, Progress, Run, Task


class WholeEpisodeCollector(StorageCollector):
    """A collector that discards unfinished episodes. Each interval of a training run cuts its last episode.

    A cut episode ends neither by termination nor by the time limit, so its replay would not end either.
    """

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Discard the unfinished episode and begin a new one."""
        self.forget()
        return super().reset(**kwargs)


def record_training(
    task: Task, folder: Path, *, force: bool = False, on_interval: OnInterval | None = None
) -> Published:
    """Train a task to its end and publish its complete episodes as the variant's tier ``replay``.

    A killed run must start again, because its transitions are stored nowhere else. The policy is not
    installed.

    Args:
        task: the training run.
        folder: state of the run. Its present content is removed.
        force: replace the dataset that has the id.
        on_interval: called with the run's progress and hyperparameters after every interval.

    Raises:
        DatasetExistsError: if the root has another dataset with this id and ``force`` is false.
        DatasetError: if the check of the new dataset fails.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    # The tier has transitions of this variant only, not of milder variants.
    task = replace(task, settings=replace(task.settings, stones=0))
    storages: list[EpisodeStorage] = []

    def record(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        storages.append(new_storage(folder / "recorded", env, {}))
        return WholeEpisodeCollector(env, storages[0])

    run = Run(task, folder, record)
    try:
        run.train(on_interval)
    finally:
        run.close()
        for storage in storages:
            storage.flush()
    dataset_id = task.variant.dataset_id(REPLAY)
    dataset = NewDataset(
        dataset_id,
        file_format.attributes(task.variant, REPLAY) | {"source": dataset_id},
        canonical_mjcf(task.variant),
        _dataset_metadata(task, run.progress),
    )
    recorded = _read_episodes(folder / "recorded")
    published = publish_episodes(dataset, environment_spec(task.variant), recorded, force=force)
    shutil.rmtree(folder)
    return published


def _read_episodes(recorded: Path) -> Iterator[EpisodeBuffer]:
    storage = MinariStorage.read(recorded)
    numbers = range(storage.total_episodes)
    seeds = (attrs["seed"] for attrs in storage.get_episode_metadata(numbers))
    for episode, seed in zip(storage.get_episodes(numbers), seeds, strict=True):
        yield EpisodeBuffer(seed=seed, **{key: episode[key] for key in file_format.ARRAYS})


def _dataset_metadata(task: Task, progress: Progress) -> dict[str, Any]:
    algorithm = task.settings.algorithm
    return {
        **reference_scores(task.variant),
        **provenance(
            algorithm=algorithm,
            description=(
                f"iMuJoCo, rebuilt: the transitions of a training run of {algorithm} on {task.variant}, "
                f"{progress.steps} steps from {task.start}, in the order of the run. "
                "Episodes that an evaluation cut short are left out."
            ),
        ),
        "policy_deterministic": False,
        "seed": task.seed,
        "hyperparameters": task.settings.asdict(),
    }
