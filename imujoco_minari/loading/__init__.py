"""Datasets as NumPy arrays and batches: load, select, split, sample."""

from imujoco_minari.loading.load import Arrays, Statistics, Trajectory, Transitions, arrays
from imujoco_minari.loading.sampling import Sampler

__all__ = ["Arrays", "Sampler", "Statistics", "Trajectory", "Transitions", "arrays"]
