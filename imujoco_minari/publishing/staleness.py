"""Whether a collection still holds what its sources hold now."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from imujoco_minari.errors import DatasetExistsError
from imujoco_minari.publishing.sources import Source, reading_errors
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.storage.metadata import read_metadata

# Ids that a message lists.
_SHOWN = 4


def check_current(dataset_id: str, sources: Sequence[Source], *, link: bool) -> None:
    """Check that a dataset of the root is the collection that combining (or linking) these sources gives.

    Raises:
        DatasetExistsError: if it is another dataset, or the sources have changed since it was combined.
        DatasetError: if it cannot be read.
    """
    metadata = read_metadata(minari_root.dataset_folder(dataset_id) / "data")
    combined, linked = metadata.get("combined_datasets"), file_format.LINKED in metadata
    ids = [source.dataset_id for source in sources]
    episodes, had = sum(len(source.episodes) for source in sources), metadata.get("total_episodes")
    if not combined or not isinstance(combined, list):
        differs = "already exists and is not a collection"
    elif combined != ids:
        lacks = [name for name in ids if name not in combined]
        more = [name for name in map(str, combined) if name not in ids]
        words = [f"lacks {_listed(lacks)}"] if lacks else []
        words += [f"also has {_listed(more)}"] if more else []
        differs = f"already combines other datasets: it {' and '.join(words) or 'has another order'}"
    elif linked != link:
        differs = f"already exists, and {'links to' if linked else 'copies'} its episodes"
    elif episodes != had:
        differs = f"is stale: it has {had} episodes, and its sources have {episodes} now"
    else:
        differs = _changed(dataset_id, metadata, sources, link)
    if differs:
        raise DatasetExistsError(f"{dataset_id} {differs}. It was not changed (--force combines it anew)")


def _changed(dataset_id: str, metadata: dict[str, Any], sources: Sequence[Source], link: bool) -> str:
    """Return words for sources that have changed since they were combined; empty if none has."""
    now: list[Any] = []
    with reading_errors(f"{dataset_id} cannot be compared with its sources"):
        for source in sources:
            with source.opened() as links:
                now += source.content(links.file, link=link)
    if file_format.collection_digest(now, link=link).items() <= metadata.items():
        return ""
    # A copy states one digest for all sources.
    then = metadata[file_format.LINKED] if link else None
    changed = []
    if isinstance(then, list):
        changed = [each.dataset_id for each, new in zip(sources, now, strict=True) if new not in then]
    return f"is stale: its sources have changed{f': {_listed(changed)}' if changed else ''}"


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
