"""Datasets into the Minari root: publish a recipe, publish given episodes, combine datasets.

Every dataset is staged, checked and committed in the same way, through
:mod:`imujoco_minari.storage.minari_root`, so a reader of the root sees whole datasets only.
"""
