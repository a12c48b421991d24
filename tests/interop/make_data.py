"""Publish a few small datasets and export them in every format, for the libraries to read back.

Run by scripts/test-interop in the package's own environment: `python make_data.py FOLDER`.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from actor_datasets import publish_actors
from doc_blocks import REPOSITORY, read_page

# Episodes that terminate (random Hoppers fall), and episodes that are truncated (HalfCheetahs cannot).
DATASETS = {
    "imujoco/hopper-base-random-v0": 6,
    "imujoco/hopper-massdec_25_leggeom-random-v0": 5,
    "imujoco/halfcheetah-base-random-v0": 2,
}
EXPORTS = {
    "hopper": ["imujoco/hopper-base-random-v0", "imujoco/hopper-massdec_25_leggeom-random-v0"],
    "halfcheetah": ["imujoco/halfcheetah-base-random-v0"],
}


def main(folder: Path) -> None:
    """Make what is missing of ``folder``."""
    os.environ["MINARI_DATASETS_PATH"] = str(folder / "root")
    from imujoco_minari.exporting import FORMATS, export
    from imujoco_minari.publishing.publisher import publish
    from imujoco_minari.variants import parse_dataset_id

    for dataset_id, episodes in DATASETS.items():
        variant, tier = parse_dataset_id(dataset_id)
        publish(variant, tier=tier, episodes=episodes)
    for page in (REPOSITORY / "docs" / "doors").glob("*.md"):
        publish_actors(read_page(page).has, folder / "root")
    for name, ids in EXPORTS.items():
        for format in FORMATS:
            export(ids, format, folder / f"{name}-{format}", force=True)
            # DI-engine's reader fails without actions.
            if format != "di-engine":
                export(ids, format, folder / f"{name}-{format}-states", states_only=True, force=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]).absolute())
