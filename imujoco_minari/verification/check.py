"""Checks everything of a dataset except its replay, in parts that processes can share.

Each part checks some episodes. Merging the parts adds the checks that need all episodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import h5py

from imujoco_minari.storage import file_format
from imujoco_minari.storage.containment import LinkedFiles
from imujoco_minari.storage.metadata import METADATA_FILE
from imujoco_minari.variants.original import CATALOGUE
from imujoco_minari.verification import bounded_read, digests, expected, identity, structure
from imujoco_minari.verification.content import Content
from imujoco_minari.verification.findings import MAX_FINDINGS, Finding, Findings, differing


def check(data: Path, metadata: Mapping[str, Any]) -> Findings:
    """Check everything of the Minari storage in the folder ``data`` except the replay of its episodes."""
    return merge(data, metadata, [check_part(data, metadata)])


def check_part(data: Path, metadata: Mapping[str, Any], number: int = 0, count: int = 1) -> Content:
    """Check one of ``count`` parts of the storage in the folder ``data``; the first checks the files too."""
    part = Content()
    try:
        _check(part, data, metadata, number, count)
    except bounded_read.UnreadableError as error:
        part.findings.append(Finding(*error.args))
        part.readable = False
    except Exception as error:  # h5py raises any kind of error on a damaged file
        part.findings.append(unreadable(data, error))
        part.readable = False
    return part


def merge(data: Path, metadata: Mapping[str, Any], parts: Iterable[Content]) -> Findings:
    """Return what the parts found, and what the checks of all episodes together find."""
    content = Content().add(parts)
    findings = Findings(content.findings, replayable=False)
    if content.readable:
        try:
            _check_whole(findings, data, metadata, content)
        except Exception as error:  # as above
            findings.append(unreadable(data, error))
            findings.replayable = False
    return findings


def unreadable(data: Path, error: Exception) -> Finding:
    """Return the finding for an error in reading a dataset."""
    return Finding(str(data), f"cannot be read: {type(error).__name__}: {str(error)[:200]}")


def _check(part: Content, data: Path, metadata: Mapping[str, Any], number: int, count: int) -> None:
    for name in (METADATA_FILE, file_format.MAIN_FILE):
        if not (data / name).is_file():
            raise bounded_read.UnreadableError(name, "is missing")
    if not metadata:
        raise bounded_read.UnreadableError(METADATA_FILE, "is no JSON object")
    if number == 0:
        # This comes before the file is opened, so that it is reported of a file that cannot be read too.
        part.findings += [*digests.files(data, metadata), *identity.loadable(metadata)]
    with LinkedFiles(file_format.main_file(data)) as files:
        bounded_read.check_names(files.file)
        total, root = len(files.file), bounded_read.attributes(files.file.id, "")
        episodes = range(total * number // count, total * (number + 1) // count)
        part.episodes = len(episodes)
        for episode in episodes:
            _check_episode(part, bounded_read.look(files, episode), episode, root, metadata)
            if len(part.findings) >= MAX_FINDINGS:
                part.sound = False
                return


def _check_episode(
    part: Content,
    episode: bounded_read.Episode,
    number: int,
    root: Mapping[str, Any],
    metadata: Mapping[str, Any],
) -> None:
    part.steps += structure.length(episode)
    part.linked &= episode.linked
    part.digests.append(str(episode.attributes.get(file_format.DIGEST)))
    broken = list(structure.arrays(episode))
    if not broken:
        read = {key: episode.arrays[key].read() for key in file_format.ARRAYS}
        broken = list(structure.values(episode, number, read))
    part.findings += broken
    if broken:
        part.sound = False
        return
    variant = identity.variant(episode)
    named = {key: str(episode.attributes.get(key, "")) for key in ("variant", CATALOGUE, "tier")}
    if variant is not None and named not in part.named:
        part.named.append(named)
    attributes = expected.policy_attributes(episode.attributes)
    if not part.runs or part.runs[-1][1] != attributes:
        part.runs.append((number, attributes))
    part.returns.append(float(episode.attributes["rewards_sum"]))
    part.unreplayed += not structure.is_replayed(episode.attributes)
    part.findings += identity.episode(episode, number, variant, root, metadata)
    changed = list(digests.arrays(episode, read))
    part.findings += changed
    part.intact &= not changed


def _check_whole(findings: Findings, data: Path, metadata: Mapping[str, Any], content: Content) -> None:
    """Add the findings of the checks that need all episodes."""
    totals = {"total_episodes": content.episodes, "total_steps": content.steps}
    obstacles = list(differing("metadata.json/", metadata, totals, ", as in the file"))
    findings += obstacles
    if obstacles or any(identity.loadable(metadata)) or not (content.named and content.sound):
        return
    with h5py.File(file_format.main_file(data), "r") as file:
        root = bounded_read.attributes(file.id, "")
    findings += identity.whole(root, metadata, content)
    known = expected.known(metadata, content)
    findings += expected.compare(metadata, content, known)
    findings.exceptions = tuple(expected.exceptions(metadata, content, known))
    if content.intact:
        findings += digests.whole(content, root, metadata)
    findings.replayable = True
