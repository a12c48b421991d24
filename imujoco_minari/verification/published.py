"""The digests of datasets that this version of the package publishes: the file ``published.json``.

``scripts/generate-digests`` writes the file. It lists datasets of the shipped experts only. A digest of an
expert that is no longer shipped does not count.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from imujoco_minari.errors import DatasetError, NotFoundError, VariantError, listed
from imujoco_minari.policies.experts import expert_record, shipped_folder
from imujoco_minari.storage import minari_root
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.variants import EXPERT, parse_dataset_id
from imujoco_minari.verification.findings import Finding, differing

FILE = Path(__file__).with_name("published.json")

# A digest follows from these and from the machine and versions that made it.
_RECIPE = ("total_episodes", "seed", "policy_sha256")
_MADE_WITH = ("versions", "machine")


def compare_with_published(wanted: Mapping[str, Any], metadata: Mapping[str, Any]) -> list[Finding]:
    """Return how a dataset differs from its :func:`published_entry`."""
    made_with = _content()["made_with"]
    recipe = {key: wanted[key] for key in _RECIPE}
    if found := list(differing("metadata.json/", metadata, recipe, ", as published")):
        return found
    other = [key for key in _MADE_WITH if metadata.get(key) != made_with.get(key)]
    reason = f" with other {' and '.join(other)}" if other else ""
    content = {"content_sha256": wanted["content_sha256"]}
    return list(differing("metadata.json/", metadata, content, f", as published{reason}"))


def published_entry(dataset_id: str) -> dict[str, Any]:
    """Return the recipe and the digest of a listed dataset, as keys and values of its metadata.

    Raises:
        NotFoundError: when no digest of it is listed.
    """
    datasets: dict[str, dict[str, Any]] = _content()["datasets"]
    found = datasets.get(dataset_id)
    if found is None or not _by_shipped_expert(dataset_id, found):
        raise NotFoundError(
            f"this version lists no digest of {dataset_id}; listed: {listed(sorted(datasets))}"
        )
    return found


def listing(dataset_ids: Iterable[str]) -> str:
    """Return the content of ``published.json`` for datasets of the Minari root.

    Digests that are listed now stay listed, if the same versions made them and their policy is still shipped.

    Raises:
        DatasetError: when a dataset is not of a shipped expert, or others were made with other versions.
    """
    datasets: dict[str, dict[str, Any]] = {}
    made_with: dict[str, Any] = {}
    for dataset_id in dataset_ids:
        metadata = read_metadata(minari_root.dataset_folder(dataset_id) / "data")
        if not _by_shipped_expert(dataset_id, metadata):
            raise DatasetError(f"{dataset_id} is not a dataset of the shipped expert")
        own = {key: metadata[key] for key in _MADE_WITH if key in metadata}
        made_with = made_with or own
        if own != made_with:
            raise DatasetError(f"{dataset_id} was made with other versions than the datasets before it")
        datasets[dataset_id] = {key: metadata[key] for key in (*_RECIPE, "content_sha256")}
    before = _content()
    if before["made_with"] == made_with:
        kept = {name: one for name, one in before["datasets"].items() if _by_shipped_expert(name, one)}
        datasets = kept | datasets
    rows = ",\n".join(f"  {json.dumps(name)}: {json.dumps(datasets[name])}" for name in sorted(datasets))
    return f'{{\n "made_with": {json.dumps(made_with)},\n "datasets": {{\n{rows}\n }}\n}}\n'


@cache
def _content() -> dict[str, Any]:
    content: dict[str, Any] = json.loads(FILE.read_text("utf-8"))
    return content


def _by_shipped_expert(dataset_id: str, stated: Mapping[str, Any]) -> bool:
    """Return whether the dataset that states this policy is of the expert that is shipped for its id."""
    try:
        variant, tier = parse_dataset_id(dataset_id)
    except VariantError:
        return False
    shipped = expert_record(variant, shipped_folder()).get("weights_sha256", "") if tier == EXPERT else ""
    return bool(stated.get("policy_sha256") == shipped)
