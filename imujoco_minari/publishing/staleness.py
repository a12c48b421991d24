"""Whether a collection still holds what its sources hold now."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import h5py

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
    try:
        now = [(len(source.episodes), _digest(source, link=link)) for source in sources]
        then = metadata[file_format.LINKED] if linked else list(_parts(data, [count for count, _ in now]))
    except (KeyError, ValueError, TypeError, RuntimeError, OSError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{dataset_id} cannot be compared with its sources: {str(error)[:200]}") from None
    changed = [name for name, old, new in zip(ids, then, now, strict=True) if tuple(old) != new]
    if changed:
        raise _differs(
            dataset_id, f"is stale: {len(changed)} of its {len(ids)} sources have changed: {_listed(changed)}"
        )


def _differs(dataset_id: str, how: str) -> DatasetExistsError:
    return DatasetExistsError(f"{dataset_id} {how}. It was not changed (--force combines it anew)")


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


def _digest(source: Source, *, link: bool) -> str:
    """Return the digest that the source's episodes have in a collection."""
    with source.opened() as file:
        if link or "content_sha256" in source.metadata:
            return source.digest(file)
        # A copy of episodes that another package published gets their digests.
        groups = (file[file_format.episode_name(number)] for number in source.episodes)
        return file_format.dataset_sha256(
            file_format.episode_sha256(file_format.array_digests(group)) for group in groups
        )


def _parts(data: Path, counts: Sequence[int]) -> Iterator[tuple[int, str]]:
    """Yield the number and the digest of the episodes that a copied collection holds of each source."""
    with h5py.File(file_format.main_file(data), "r") as file:
        start = 0
        for count in counts:
            names = map(file_format.episode_name, range(start, start + count))
            yield (
                count,
                file_format.dataset_sha256(str(file[name].attrs[file_format.DIGEST]) for name in names),
            )
            start += count
