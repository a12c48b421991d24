"""The tier ``replay``: the transitions of a training run, recorded as it explores and learns."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

from imujoco_minari.envs.mjcf import canonical_mjcf
from imujoco_minari.envs.registration import environment_spec
from imujoco_minari.policies.references import reference_scores
from imujoco_minari.policies.tiers import REPLAY
from imujoco_minari.publishing.collector import FolderCollector
from imujoco_minari.publishing.publisher import External, Published, publish_episodes
from imujoco_minari.storage import file_format
from imujoco_minari.training.run import OnInterval, Progress, Run, Task


class ReplayCollector(FolderCollector):
    """A collector that forgets an episode cut short, as each interval of a run cuts its last one.

    Such an episode ends neither by termination nor by the time limit, and no replay would end it there.
    """

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, and forget the one that has not ended."""
        self._buffer = None
        return super().reset(**kwargs)


def record_replay(
    task: Task, folder: Path, *, force: bool = False, on_interval: OnInterval | None = None
) -> Published:
    """Train a task to its last step and publish all its whole episodes as the variant's tier ``replay``.

    A recorded run that was killed begins anew: its transitions are kept nowhere else. The policy that it
    ends with is not installed.

    Args:
        task: what to train.
        folder: state of the run; what is there is discarded.
        force: replace a dataset that has the id.
        on_interval: called with the run's progress and hyperparameters after every evaluation.
    """
    shutil.rmtree(folder, ignore_errors=True)
    # The tier holds this variant's transitions, not those of milder ones.
    task = replace(task, settings=replace(task.settings, stones=0))
    collectors: list[ReplayCollector] = []
    attributes = file_format.attributes(task.variant, REPLAY)
    dataset_id = task.variant.dataset_id(REPLAY)

    def record(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        folder.mkdir(parents=True, exist_ok=True)
        collectors.append(ReplayCollector(env, folder, attributes))
        return collectors[0]

    run = Run(task, folder, record)
    try:
        run.train(on_interval)
        collectors[0]._buffer = None
        collectors[0].keep(folder / "recorded")
    finally:
        for collector in collectors:
            collector.close()
    external = External(
        dataset_id,
        attributes | {"source": dataset_id},
        environment_spec(task.variant),
        canonical_mjcf(task.variant),
        _metadata(task, run.progress),
    )
    published = publish_episodes(external, _episodes(folder / "recorded"), force=force)
    shutil.rmtree(folder)
    return published


def _episodes(recorded: Path) -> Iterator[EpisodeBuffer]:
    storage = MinariStorage.read(recorded)
    numbers = range(storage.total_episodes)
    seeds = (attrs["seed"] for attrs in storage.get_episode_metadata(numbers))
    for episode, seed in zip(storage.get_episodes(numbers), seeds, strict=True):
        yield EpisodeBuffer(seed=seed, **{key: episode[key] for key in file_format.ARRAYS})


def _metadata(task: Task, progress: Progress) -> dict[str, Any]:
    return reference_scores(task.variant) | {
        "algorithm_name": task.settings.algorithm,
        "author": {"imujoco_minari"},
        "code_permalink": f"imujoco-minari=={version('imujoco-minari')}",
        "description": (
            f"iMuJoCo, rebuilt: the transitions of a training run of {task.settings.algorithm} on "
            f"{task.variant}, {progress.steps} steps from {task.start}, in the order of their making; "
            "episodes that an evaluation cut short are left out."
        ),
        "requirements": [f"{name}=={version(name)}" for name in ("mujoco", "gymnasium")],
        "policy_deterministic": False,
        "seed": task.seed,
        "hyperparameters": task.settings.asdict(),
    }
