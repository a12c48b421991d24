"""Minari-compatible dataset publisher for iMuJoCo, a benchmark of perturbed MuJoCo robots.

Importing this package registers every variant of the catalogue with Gymnasium. MuJoCo, Minari and torch are
imported when they are first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from imujoco_minari.envs.registration import load_catalogue, make, randomised, register, register_catalogue
from imujoco_minari.errors import ImujocoError
from imujoco_minari.variants import Ranges, Variant, bases, catalogue

if TYPE_CHECKING:
    from minari import list_local_datasets

    from imujoco_minari.envs.mjcf import canonical_mjcf
    from imujoco_minari.exporting import export
    from imujoco_minari.loading import Sampler, arrays, few_shot
    from imujoco_minari.policies import load_policy
    from imujoco_minari.policies.evaluation import evaluate
    from imujoco_minari.policies.references import normalized_score
    from imujoco_minari.publishing.combiner import combine_datasets
    from imujoco_minari.publishing.on_demand import load_dataset
    from imujoco_minari.publishing.publisher import publish
    from imujoco_minari.variants.off_dynamics import off_dynamics, off_dynamics_names
    from imujoco_minari.variants.splits import held_out
    from imujoco_minari.verification import verify

__version__: str
__all__ = [
    "ImujocoError",
    "Ranges",
    "Sampler",
    "Variant",
    "arrays",
    "bases",
    "canonical_mjcf",
    "catalogue",
    "combine_datasets",
    "evaluate",
    "export",
    "few_shot",
    "held_out",
    "list_local_datasets",
    "load_catalogue",
    "load_dataset",
    "load_policy",
    "make",
    "normalized_score",
    "off_dynamics",
    "off_dynamics_names",
    "publish",
    "randomised",
    "register",
    "verify",
]

_LAZY = {
    "Sampler": "loading",
    "arrays": "loading",
    "canonical_mjcf": "envs.mjcf",
    "combine_datasets": "publishing.combiner",
    "evaluate": "policies.evaluation",
    "export": "exporting",
    "few_shot": "loading",
    "held_out": "variants.splits",
    "load_dataset": "publishing.on_demand",
    "load_policy": "policies",
    "normalized_score": "policies.references",
    "off_dynamics": "variants.off_dynamics",
    "off_dynamics_names": "variants.off_dynamics",
    "publish": "publishing.publisher",
    "verify": "verification",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        # A tenth of the import's time, for what is seldom asked.
        from importlib.metadata import version

        return version("imujoco-minari")
    if name == "list_local_datasets":
        # Minari's own, here because users expect it beside load_dataset.
        return import_module("minari").list_local_datasets
    if name in _LAZY:
        return getattr(import_module(f"imujoco_minari.{_LAZY[name]}"), name)
    raise AttributeError(f"module 'imujoco_minari' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the public names, also those that are imported when they are first used."""
    return sorted({*filter(lambda name: name.startswith("__"), globals()), "__version__", *__all__})


register_catalogue()
