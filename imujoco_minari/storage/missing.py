"""The error for a dataset that is not in the Minari root. It names the command that makes it."""

from __future__ import annotations

from imujoco_minari.errors import DatasetNotFoundError, VariantError
from imujoco_minari.storage import minari_root
from imujoco_minari.variants import EXPERT, NAMESPACE, parse_dataset_id
from imujoco_minari.variants.named_collections import NamedCollection


def not_in_root(dataset_id: str) -> DatasetNotFoundError:
    """Return the error for the id of a dataset that the Minari root does not hold.

    Example:
        >>> print(not_in_root("imujoco/hopper-base-random-v0"))
        imujoco/hopper-base-random-v0 is not in the Minari root, at .../imujoco/hopper-base-random-v0;
        make it with `imujoco publish hopper-base --tier random`
    """
    command, why = making(dataset_id), ""
    if not command and dataset_id.startswith(f"{NAMESPACE}/"):
        try:
            parse_dataset_id(dataset_id)
        except VariantError as error:
            why = f". It names no variant: {error}"
    advice = f"make it with `{command}`" if command else f"see `minari list local`{why}"
    folder = minari_root.dataset_folder(dataset_id)
    return DatasetNotFoundError(f"{dataset_id} is not in the Minari root, at {folder}; {advice}")


def making(dataset_id: str) -> str:
    """Return the command that makes the dataset ``dataset_id``; empty when the id is not one of ours."""
    if dataset_id.startswith(f"{NAMESPACE}-original/"):
        return "imujoco import-archive DIR"
    collection = NamedCollection.parse(dataset_id)
    if collection is not None:
        category = f" --category {collection.category}" if collection.category else ""
        return f"imujoco combine --robot {collection.robot}{category}{_option(collection.tier)}"
    try:
        variant, tier = parse_dataset_id(dataset_id)
    except VariantError:
        return ""
    if tier == "replay":
        return f"imujoco train {variant} --record-replay"
    return f"imujoco publish {variant}{_option(tier)}"


def _option(tier: str) -> str:
    return "" if tier == EXPERT else f" --tier {tier}"
