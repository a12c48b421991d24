"""Sharing datasets through Minari's remotes, ``hf://user`` and ``gcp://bucket``.

What lies on a remote is stock Minari's layout: ``minari list remote`` and ``minari.download_dataset``
serve it to people who have no code of ours. Pushing and pulling add what Minari leaves to chance: the
digests are checked on both ends, and at no moment does a half-written dataset show.
"""

from __future__ import annotations

from imujoco_minari.remotes.pulling import Pulled, pull, pull_all
from imujoco_minari.remotes.pushing import Pushed, push, push_all

__all__ = ["Pulled", "Pushed", "pull", "pull_all", "push", "push_all"]
