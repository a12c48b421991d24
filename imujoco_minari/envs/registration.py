"""Gymnasium's registry and the variants: every catalogue id, and any other on demand.

Entry points are strings and the only keyword is ``variant`` (``variants`` for a collection), so a
spec stored in a dataset works on any machine that has this package.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, registry

from imujoco_minari.variants import CATEGORIES, NAMESPACE, ROBOTS, Variant, bases, catalogue, specification

MAX_EPISODE_STEPS = 1000


def environment_spec(variant: Variant | str) -> EnvSpec:
    """Return the Gymnasium spec of a variant's environment.

    Raises:
        VariantError: when ``variant`` is no variant id.
    """
    if isinstance(variant, str):
        variant = Variant.parse(variant)
    return EnvSpec(
        id=variant.environment_id,
        entry_point=f"imujoco_minari.envs:{specification(variant.robot).title}VariantEnv",
        max_episode_steps=MAX_EPISODE_STEPS,
        kwargs={"variant": str(variant)},
    )


def collection_spec(name: str, variants: Iterable[Variant | str]) -> EnvSpec:
    """Return the Gymnasium spec of a collection's environment, ``imujoco/<name>-v0``."""
    return EnvSpec(
        id=f"{NAMESPACE}/{name}-v0",
        entry_point="imujoco_minari.envs:CollectionEnv",
        max_episode_steps=MAX_EPISODE_STEPS,
        kwargs={"variants": [str(variant) for variant in variants]},
    )


def make(variant: Variant | str, **kwargs: Any) -> gym.Env[Any, Any]:
    """Make the environment of any variant of the grammar, in the catalogue or not.

    Args:
        variant: a variant or its id, as in ``hopper-massinc_37_torsogeom``.
        **kwargs: what ``gymnasium.make`` takes, ``render_mode`` among them.

    Raises:
        VariantError: when ``variant`` is no variant id.
    """
    return gym.make(environment_spec(variant), **kwargs)


def register(variant: Variant | str) -> str:
    """Register a variant outside the catalogue with Gymnasium and return its environment id.

    Raises:
        VariantError: when ``variant`` is no variant id.
    """
    spec = environment_spec(variant)
    registry.setdefault(spec.id, spec)
    return spec.id


def register_catalogue() -> None:
    """Register the 154 variants, the three bases, and each robot's collections."""
    # Straight into the registry: gym.register() compares versions over the whole registry at each
    # call, and 172 calls would take a third of a second of every import.
    for variant in (*catalogue(), *bases()):
        spec = environment_spec(variant)
        registry.setdefault(spec.id, spec)
    for robot in ROBOTS:
        for category in (None, *CATEGORIES):
            spec = collection_spec(f"{robot}-{category or 'all'}", catalogue(robot, category))
            registry.setdefault(spec.id, spec)
