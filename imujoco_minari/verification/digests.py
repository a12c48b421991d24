"""Checks the digests of the files, of every array, and of the whole dataset."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

from imujoco_minari.storage import file_format
from imujoco_minari.storage.metadata import sources
from imujoco_minari.verification.bounded_read import Episode
from imujoco_minari.verification.content import Content
from imujoco_minari.verification.findings import Finding, differing, differs, same, shown


def files(data: Path, metadata: Mapping[str, Any]) -> Iterator[Finding]:
    """Report files that have changed since they were published."""
    main_file = file_format.main_file(data)
    for key, name, digest in (
        (file_format.METADATA_DIGEST, "metadata.json", file_format.metadata_sha256(metadata)),
        (file_format.FILE_DIGEST, file_format.MAIN_FILE, file_format.file_sha256(main_file)),
    ):
        if key not in metadata:
            yield Finding(f"metadata.json/{key}", "is missing")
        elif metadata[key] != digest:
            yield Finding(name, f"has changed since it was published: its digest is not {key}")


def arrays(episode: Episode, read: Mapping[str, Any]) -> Iterator[Finding]:
    """Report arrays of an episode without the digest stored with them, and an episode without its own.

    ``read`` holds the values of the arrays that have been read before.
    """
    digests = {}
    for key, array in sorted(episode.arrays.items()):
        digests[key] = file_format.array_sha256(read[key] if key in read else array.read())
        stated = array.attributes.get(file_format.DIGEST)
        if not same(stated, digests[key]):
            yield Finding(
                f"{episode.name}/{key}",
                "does not have the digest stored with it" if stated is not None else "has no digest",
            )
    if not same(episode.attributes.get(file_format.DIGEST), file_format.episode_sha256(digests)):
        yield Finding(f"{episode.name}@{file_format.DIGEST}", "is not the digest of the episode's arrays")


def whole(content: Content, root: Mapping[str, Any], metadata: Mapping[str, Any]) -> Iterator[Finding]:
    """Report a dataset whose digest is not that of its episodes, given the attributes of its file."""
    if content.linked:
        yield from _linked(content.digests, metadata)
        return
    digest = {"content_sha256": file_format.dataset_sha256(content.digests)}
    yield from differing("@", root, digest)
    yield from differing("metadata.json/", metadata, digest)


def _linked(episodes: Sequence[str], metadata: Mapping[str, Any]) -> Iterator[Finding]:
    """Report sources of a linked collection that were replaced since it was made."""
    where = f"metadata.json/{file_format.LINKED}"
    stated = metadata.get(file_format.LINKED)
    try:
        counts = [int(count) for count, _ in stated or []]
        digests = [str(digest) for _, digest in stated or []]
    except (TypeError, ValueError):
        counts, digests = [], []
    if sum(counts) != len(episodes) or min(counts, default=0) < 0:
        yield differs(where, stated, f"a description of {len(episodes)} episodes")
        return
    ends = list(accumulate(counts))
    names = sources(metadata)
    for number, (start, end, digest) in enumerate(zip([0, *ends], ends, digests, strict=False)):
        if file_format.dataset_sha256(episodes[start:end]) != digest:
            source = names[number] if number < len(names) else number
            yield Finding(where, f"{shown(source)} was replaced since the collection linked to it")
