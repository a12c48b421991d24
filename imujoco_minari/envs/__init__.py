"""Variants as Gymnasium environments: from a variant to an MJCF text to an environment.

This package edits the models, registers the environments and compares models in physical quantities.
Datasets store the entry points ``imujoco_minari.envs:HopperVariantEnv`` and so on, so these names must not
change.
"""

from __future__ import annotations

from typing import Any

from imujoco_minari.envs.registration import (
    collection_spec,
    environment_spec,
    load_catalogue,
    make,
    randomised,
    randomised_spec,
    register,
    register_catalogue,
)
from imujoco_minari.variants import known_robots, specification

__all__ = [
    "collection_spec",
    "environment_spec",
    "load_catalogue",
    "make",
    "randomised",
    "randomised_spec",
    "register",
    "register_catalogue",
]


def __getattr__(name: str) -> Any:
    # The environments import MuJoCo, which takes longer than the rest of the package.
    if name in ("CollectionEnv", "RandomisedEnv"):
        from imujoco_minari.envs import drawing

        return getattr(drawing, name)
    if name.endswith("VariantEnv"):
        from imujoco_minari.envs.robots import variant_class

        return variant_class(name.removesuffix("VariantEnv"))
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the public names, also those that are imported when they are first used."""
    own = (name for name in globals() if name.startswith("__"))
    robots = (f"{specification(robot).title}VariantEnv" for robot in known_robots())
    return sorted({*own, *__all__, *robots, "CollectionEnv", "RandomisedEnv"})
