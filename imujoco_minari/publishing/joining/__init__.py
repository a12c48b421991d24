"""Files of datasets joined into one by moving their bytes, without HDF5 looking at each object."""

from imujoco_minari.publishing.joining.joiner import Joiner
from imujoco_minari.publishing.joining.layout import Layout
from imujoco_minari.publishing.joining.records import NotPlainError

__all__ = ["Joiner", "Layout", "NotPlainError"]
