"""Adds datasets to the Minari root: publishes recipes and given episodes, and combines datasets.

Every dataset is staged, checked and committed through :mod:`imujoco_minari.storage.minari_root`, so a reader
of the root sees complete datasets only.
"""
