"""Earlier names of the environments of the original archive's variants.

Datasets that were published by earlier versions store these names as entry points, so the names must stay.
New datasets store names of ``imujoco_minari.envs``; ``current_spec`` in ``envs.registration`` translates.
"""

from imujoco_minari.envs import drawing, robots

OriginalHopperEnv = robots.HopperVariantEnv
OriginalHalfCheetahEnv = robots.HalfCheetahVariantEnv
OriginalWalker2dEnv = robots.Walker2dVariantEnv
OriginalCollectionEnv = drawing.CollectionEnv
