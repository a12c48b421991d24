"""Rollouts recorded by ``minari.DataCollector``: a policy and a variant in, stored episodes out.

A collector writes to a folder that it is given; where datasets live, and when one becomes visible,
is :mod:`imujoco_minari.publishing`'s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import gymnasium as gym
from minari import DataCollector

from imujoco_minari.policies import Policy
from imujoco_minari.registration import make
from imujoco_minari.rollouts import episode_seed, roll_out
from imujoco_minari.variants import Variant


class FolderCollector(DataCollector):
    """A ``minari.DataCollector`` that records into one folder and leaves it there.

    The stock collector takes its place from the process-wide ``MINARI_DATASETS_PATH`` and, in
    ``create_dataset``, moves files one by one into a dataset that is already visible.
    """

    def __init__(self, env: gym.Env[Any, Any], folder: Path) -> None:
        self._folder = str(folder)
        super().__init__(env)

    @property
    def datasets_path(self) -> str:
        """The folder in which the collector makes its storage."""
        return self._folder

    @datasets_path.setter
    def datasets_path(self, value: str) -> None:
        """Ignore the process-wide root that the stock constructor assigns."""

    def keep(self, target: Path) -> None:
        """Close the environment and move ``main_data.hdf5`` and ``metadata.json`` to ``target``."""
        self._flush_to_storage()
        self.env.close()
        Path(self._storage.data_path).rename(target)
        # The stock close() would fail on the folder that has moved.
        self._tmp_dir.cleanup()


def collect(
    variant: Variant,
    policy: Policy,
    episodes: Iterable[int],
    seed: int,
    target: Path,
    on_episode: Callable[[], None] | None = None,
) -> None:
    """Record the numbered ``episodes`` of a dataset as a Minari storage in the new folder ``target``.

    Args:
        variant: whose environment is stepped.
        policy: chooses the actions.
        episodes: numbers of the episodes within the dataset; each is seeded by its own.
        seed: base seed of the dataset.
        target: the storage's folder; its parent exists.
        on_episode: called after each episode.
    """
    collector = FolderCollector(make(variant), target.parent)
    for episode in episodes:
        roll_out(collector, policy, episode_seed(seed, episode))
        if on_episode is not None:
            on_episode()
    collector.keep(target)
