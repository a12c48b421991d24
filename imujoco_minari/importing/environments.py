"""The original's variants as Gymnasium environments: v5's rules around the archive's model.

Rewards, observations and termination are those of Gymnasium's v5 environments, as everywhere in this
package; the original used gym's v3, whose differences ``docs/original-archive.md`` lists.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gymnasium.utils import EzPickle

from imujoco_minari.envs.external_mjcf import check_text
from imujoco_minari.envs.robots import (
    CollectionEnv,
    HalfCheetahVariantEnv,
    HopperVariantEnv,
    VariantEnv,
    Walker2dVariantEnv,
)
from imujoco_minari.variants.original import OriginalVariant


class OriginalEnv(VariantEnv):
    """What the three robots' environments of the original's variants share.

    Args:
        variant: id of the variant in the archive, as in ``hopper-massdec_25_leggeom``.
        mjcf: text of its model.
        **kwargs: what Gymnasium's environment of the robot takes, ``render_mode`` among them.
    """

    def __init__(self, variant: str, mjcf: str, **kwargs: Any) -> None:
        self.variant = OriginalVariant.parse(variant)
        # A spec can come with a dataset from anywhere, and its model must not load files from here.
        check_text(mjcf, variant)
        self.mjcf = mjcf
        super(VariantEnv, self).__init__(**kwargs)
        EzPickle.__init__(self, variant, mjcf, **kwargs)


class OriginalHopperEnv(OriginalEnv, HopperVariantEnv):
    """``Hopper-v5`` around a model of the archive."""


class OriginalHalfCheetahEnv(OriginalEnv, HalfCheetahVariantEnv):
    """``HalfCheetah-v5`` around a model of the archive."""


class OriginalWalker2dEnv(OriginalEnv, Walker2dVariantEnv):
    """``Walker2d-v5`` around a model of the archive."""


ENVIRONMENTS: dict[str, type[OriginalEnv]] = {
    "hopper": OriginalHopperEnv,
    "halfcheetah": OriginalHalfCheetahEnv,
    "walker2d": OriginalWalker2dEnv,
}


class OriginalCollectionEnv(CollectionEnv):
    """One robot in many of the original's variants, one of them an episode.

    Args:
        models: ids of variants of one robot -> the texts of their models.
        **kwargs: passed to each variant's environment.
    """

    def __init__(self, models: Mapping[str, str], **kwargs: Any) -> None:
        EzPickle.__init__(self, models, **kwargs)
        self._models = dict(models)
        self._begin([OriginalVariant.parse(name) for name in models], kwargs)

    def _make(self, name: str) -> VariantEnv:
        robot = OriginalVariant.parse(name).robot
        return ENVIRONMENTS[robot](name, self._models[name], **self._kwargs)
