"""Datasets as NumPy arrays and batches.

This package loads datasets and collections, selects and splits their episodes, and draws batches. It requires
only h5py and NumPy.
"""

from imujoco_minari.loading.batches import (
    Windows,
    episode_batches,
    transition_batches,
    transition_samples,
    window_batches,
)
from imujoco_minari.loading.episode_arrays import STEP_ARRAYS, Arrays, Trajectory, TransitionBatch
from imujoco_minari.loading.load import arrays
from imujoco_minari.loading.preferences import Preferences, preference_pairs
from imujoco_minari.loading.sampling import FewShot, Sampler, Shots, few_shot
from imujoco_minari.loading.selection import ATTRIBUTES, Datasets, Origin
from imujoco_minari.loading.statistics import Statistics

__all__ = [
    "ATTRIBUTES",
    "STEP_ARRAYS",
    "Arrays",
    "Datasets",
    "FewShot",
    "Origin",
    "Preferences",
    "Sampler",
    "Shots",
    "Statistics",
    "Trajectory",
    "TransitionBatch",
    "Windows",
    "arrays",
    "episode_batches",
    "few_shot",
    "preference_pairs",
    "transition_batches",
    "transition_samples",
    "window_batches",
]
