"""Whether a collection still holds what its sources hold now."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from imujoco_minari.errors import DatasetError, DatasetExistsError
from imujoco_minari.publishing.sources import Source
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.storage.metadata import read_metadata

# Ids that a message lists.
_SHOWN = 4


def check_current(dataset_id: str, sources: Sequence[Source], *, link: bool) -> None:
    """Check that a dataset is the collection that combining these sources would make.

    Args:
        dataset_id: id of a dataset in the Minari root.
        sources: the sources, in order.
        link: whether the collection would link to their episodes.

    Raises:
        DatasetExistsError: if it is another dataset, or the sources have changed since it was combined.
        DatasetError: if it cannot be read.
    """
    data = minari_root.dataset_folder(dataset_id) / "data"
    metadata = read_metadata(data)
    combined, linked = metadata.get("combined_datasets"), file_format.LINKED in metadata
    if not combined or not isinstance(combined, list):
        raise _differs(dataset_id, "already exists and is not a collection")
    ids = [source.dataset_id for source in sources]
    if combined != ids:
        words = [
            f"{verb} {_listed(names)}"
            for verb, names in (
                ("lacks", [name for name in ids if name not in combined]),
                ("also has", [name for name in map(str, combined) if name not in ids]),
            )
            if names
        ]
        raise _differs(
            dataset_id, f"already combines other datasets: it {' and '.join(words) or 'has another order'}"
        )
    if linked != link:
        raise _differs(dataset_id, f"already exists, and {'links to' if linked else 'copies'} its episodes")
    episodes = sum(len(source.episodes) for source in sources)
    if episodes != metadata.get("total_episodes"):
        had = metadata.get("total_episodes")
        raise _differs(dataset_id, f"is stale: it has {had} episodes, and its sources have {episodes} now")
    now: list[Any] = []
    try:
        for source in sources:
            with source.opened() as links:
                now += source.content(links.file, link=link)
    except (KeyError, ValueError, TypeError, RuntimeError, OSError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{dataset_id} cannot be compared with its sources: {str(error)[:200]}") from None
    if not file_format.collection_digest(now, link=link).items() <= metadata.items():
        then = metadata[file_format.LINKED] if link else None
        # A copy states one digest for all sources.
        changed = isinstance(then, list) and [
            name for name, new in zip(ids, now, strict=True) if new not in then
        ]
        which = f": {_listed(changed)}" if changed else ""
        raise _differs(dataset_id, f"is stale: its sources have changed{which}")


def _differs(dataset_id: str, how: str) -> DatasetExistsError:
    return DatasetExistsError(f"{dataset_id} {how}. It was not changed (--force combines it anew)")


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
