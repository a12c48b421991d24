"""A static website of the variants: pictures, numbers, returns, and code to load them.

:mod:`~imujoco_minari.pictures.gallery.entries` collects the facts about a variant, ``clips`` draws it,
``pages`` writes its HTML, and ``builder`` builds the site.
"""

from __future__ import annotations

from imujoco_minari.pictures.gallery.builder import Built, build

__all__ = ["Built", "build"]
