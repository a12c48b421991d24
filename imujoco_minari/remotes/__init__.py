"""Sharing datasets through Minari's remotes, ``hf://user`` and ``gcp://bucket``: push and pull.

A remote has the layout of stock Minari, so ``minari list remote`` and ``minari.download_dataset`` work
without this package. ``push`` and ``pull`` also check the digests on both ends, and show
complete datasets only.
"""

from __future__ import annotations

from imujoco_minari.remotes.pulling import Pulled, pull, pull_all
from imujoco_minari.remotes.pushing import Pushed, collections_of, plan_push, push, push_all

__all__ = ["Pulled", "Pushed", "collections_of", "plan_push", "pull", "pull_all", "push", "push_all"]
