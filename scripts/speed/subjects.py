"""The datasets that the benchmarks use, in a temporary Minari root."""

from __future__ import annotations

import json
import shutil

from imujoco_minari.publishing.publisher import publish_recipe
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.storage import minari_root
from imujoco_minari.variants import Variant


def publish_copies(variant: Variant, episodes: int, copies: int) -> list[str]:
    """Publish a dataset and copies of it with other ids. Stock Minari combines only equal environments."""
    first = publish_recipe(Recipe(variant, episodes=episodes)).dataset_id
    ids = []
    for number in range(copies):
        dataset_id = f"bench/{variant.robot}-{number}-v0"
        folder = minari_root.dataset_folder(dataset_id)
        if not folder.exists():
            shutil.copytree(minari_root.dataset_folder(first), folder)
            path = folder / "data" / "metadata.json"
            path.write_text(json.dumps(json.loads(path.read_text("utf-8")) | {"dataset_id": dataset_id}))
        ids.append(dataset_id)
    return ids
