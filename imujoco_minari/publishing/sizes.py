"""How much disk a dataset will take, known before its episodes are made."""

from __future__ import annotations

import shutil

from imujoco_minari.envs.registration import MAX_EPISODE_STEPS, max_episode_steps
from imujoco_minari.errors import StorageError
from imujoco_minari.policies import expert_record
from imujoco_minari.policies.tiers import RANDOM
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.storage import minari_root
from imujoco_minari.variants import EXPERT, Variant, specification

# Groups, digests and metadata of an episode, beside its steps.
_BYTES_PER_EPISODE = 4500


def expected_bytes(recipe: Recipe) -> int:
    """Return about how many bytes the dataset of a recipe takes."""
    steps = recipe.episodes * steps_per_episode(recipe)
    return round(steps * bytes_per_step(recipe.nominal) + recipe.episodes * _BYTES_PER_EPISODE)


def bytes_per_step(variant: Variant) -> int:
    """Return the size of a step: observations and rewards are 8 bytes a number, actions 4, the flags 1."""
    observation, action = specification(variant.robot).sizes
    return 8 * observation + 4 * action + 10


def steps_per_episode(recipe: Recipe) -> float:
    """Return the mean length of an episode by the record of the expert, or else the time limit."""
    key = {EXPERT: "evaluation", RANDOM: "random"}.get(recipe.tier) if recipe.policy is None else None
    evaluation = expert_record(recipe.nominal).get(key or "", {})
    return float(evaluation.get("length_mean", max_episode_steps(recipe.nominal.robot) or MAX_EPISODE_STEPS))


def check_space(name: str, needed: int) -> None:
    """Raise a StorageError that begins with ``name`` if the Minari root's disk lacks ``needed`` bytes."""
    root = minari_root.datasets_root()
    folder = next(each for each in (root, *root.parents) if each.exists())
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise StorageError(
            f"{name}: about {needed / 1e6:.1f} MB needed, {free / 1e6:.1f} MB free on the disk of {root}; "
            "valid: MINARI_DATASETS_PATH may name a folder on another disk"
        )
