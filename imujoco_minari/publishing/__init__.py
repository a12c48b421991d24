"""Datasets into the Minari root: publish a recipe, publish given episodes, combine datasets.

All writers go through the one staging and commit of :mod:`imujoco_minari.storage.minari_root`.
"""
