"""Training: an expert for a variant, from scratch or warm-started from the base robot's whole agent.

Needs the extra ``[train]`` (SBX, and with it JAX). Nothing here knows of datasets, except that a run
can be recorded (:mod:`imujoco_minari.training.recording`).
"""
