"""Are the bytes those that were published? Digests of the files, of every array, and of the whole."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py

from imujoco_minari import content
from imujoco_minari.verification.findings import Finding, same, shown


def files(data: Path, metadata: dict[str, Any]) -> Iterator[Finding]:
    """Report files that have changed since they were sealed, in whatever byte."""
    for key, name, digest in (
        (content.METADATA_DIGEST, "metadata.json", content.metadata_sha256(metadata)),
        (content.FILE_DIGEST, content.MAIN_FILE, content.file_sha256(content.main_file(data))),
    ):
        if key not in metadata:
            yield Finding(f"metadata.json/{key}", "is missing")
        elif metadata[key] != digest:
            yield Finding(name, f"has changed since it was published: its digest is not {key}")


def arrays(file: h5py.File, metadata: dict[str, Any]) -> Iterator[Finding]:
    """Report arrays without the digest stored with them, and a dataset whose arrays are not its own."""
    intact = True
    for number in range(len(file)):
        group, digests = file[f"episode_{number}"], {}
        for key, array in content.arrays(group):
            digests[key] = content.array_sha256(array[()])
            stated = array.attrs.get(content.DIGEST)
            if not isinstance(stated, str) or stated != digests[key]:
                intact = False
                yield Finding(
                    f"episode_{number}/{key}",
                    "does not have the digest stored with it" if stated is not None else "has no digest",
                )
        if not same(group.attrs.get(content.DIGEST), content.episode_sha256(digests)):
            intact = False
            yield Finding(f"episode_{number}@{content.DIGEST}", "is not the digest of the episode's arrays")
    if not intact or ("content_sha256" not in {**file.attrs, **metadata} and _links(file)):
        return
    digest = content.content_sha256(file, len(file))
    for where, stated in (
        ("@content_sha256", file.attrs.get("content_sha256")),
        ("metadata.json/content_sha256", metadata.get("content_sha256")),
    ):
        if not isinstance(stated, str) or stated != digest:
            yield Finding(where, f"is {shown(stated)}, but the content's is {digest}")


def _links(file: h5py.File) -> bool:
    """Return whether the file is a linked collection, which keeps no digest of what lies elsewhere."""
    return all(isinstance(file.get(name, getlink=True), h5py.ExternalLink) for name in file)
