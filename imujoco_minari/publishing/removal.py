"""Deleting datasets from the Minari root, except those that a linked collection still needs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from imujoco_minari.errors import DatasetError, ImujocoError
from imujoco_minari.publishing.outcome import Deleted
from imujoco_minari.storage import file_format, minari_root, transactions
from imujoco_minari.storage.metadata import METADATA_FILE, local_collections, sources
from imujoco_minari.storage.missing import not_in_root


def delete(dataset_ids: Sequence[str], *, force: bool = False) -> Iterator[Deleted]:
    """Delete datasets from the Minari root and yield each outcome when it is ready, failures included.

    A dataset disappears in one step. It is not deleted if a linked collection refers to its episodes, unless
    the collection is deleted too. A folder that has other files too is never deleted.

    Args:
        dataset_ids: the datasets.
        force: delete datasets that linked collections refer to. Those collections become unreadable.
    """
    links = linked_collections()
    pending = list(dict.fromkeys(dataset_ids))
    while pending:
        # Collections go before the datasets that they link to.
        dataset_id = min(pending, key=lambda each: len(links.get(each, set()) & set(pending)))
        pending.remove(dataset_id)
        try:
            with minari_root.storage_errors(minari_root.dataset_folder(dataset_id)):
                outcome = _delete(dataset_id, set() if force else links.get(dataset_id, set()))
        except ImujocoError as error:
            outcome = Deleted.failed(dataset_id, error)
        else:
            for collections in links.values():
                collections.discard(dataset_id)
        yield outcome


def _delete(dataset_id: str, collections: set[str]) -> Deleted:
    folder = minari_root.dataset_folder(dataset_id)
    if not minari_root.exists(dataset_id):
        raise not_in_root(dataset_id)
    data = folder / "data"
    if not (file_format.main_file(data).is_file() or (data / METADATA_FILE).is_file()):
        raise DatasetError(f"{dataset_id} was not deleted: there is no dataset at {folder}")
    others = sorted(path.name for path in folder.iterdir() if path.name != "data")
    if others:
        raise DatasetError(
            f"{dataset_id} was not deleted: {folder} holds other files too: {', '.join(others[:3])}"
        )
    if collections:
        raise DatasetError(
            f"{dataset_id} was not deleted: {', '.join(sorted(collections))} links to its episodes; "
            "delete that first, or give --force"
        )
    size = sum(path.lstat().st_size for path in data.rglob("*") if path.is_file())
    transactions.remove(dataset_id)
    return Deleted(dataset_id, folder, bytes=size)


def linked_collections() -> dict[str, set[str]]:
    """Return the ids of the linked collections of the root that refer to each dataset."""
    found: dict[str, set[str]] = {}
    for collection, metadata in local_collections():
        if file_format.LINKED in metadata:
            for source in sources(metadata):
                found.setdefault(source, set()).add(collection)
    return found
