"""Checks everything of a dataset except its replay, in parts that processes can share.

Each part checks some episodes, and keeps their steps, variants, digests and so on. Merging the parts adds
the checks that need all episodes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import h5py

from imujoco_minari.storage import file_format
from imujoco_minari.storage.containment import LinkedFiles
from imujoco_minari.storage.metadata import METADATA_FILE
from imujoco_minari.variants.original import CATALOGUE, variant_of
from imujoco_minari.verification import bounded_read, digests, expected, identity, structure
from imujoco_minari.verification.expected import Content
from imujoco_minari.verification.findings import MAX_FINDINGS, Finding, Findings, differing


@dataclass
class PartialCheck:
    """The result of checking some of a dataset's episodes.

    Attributes:
        findings: what is wrong with them.
        readable: whether all of them could be read.
        sound: whether all of them are complete enough to be replayed.
        intact: whether no digest differs.
        linked: whether all of them are links to other files.
        episodes: number of episodes in the whole dataset.
        steps: number of their steps.
        identities: the attributes that name variant and tier, each combination once.
        runs: see :class:`~imujoco_minari.verification.expected.Content`.
        unreplayed: how many of them were imported without seeds.
        returns: their returns, as stated.
        digests: their digests, as stored.
    """

    findings: list[Finding] = field(default_factory=list)
    readable: bool = True
    sound: bool = True
    intact: bool = True
    linked: bool = True
    episodes: int = 0
    steps: int = 0
    identities: list[dict[str, str]] = field(default_factory=list)
    runs: list[tuple[int, dict[str, Any]]] = field(default_factory=list)
    unreplayed: int = 0
    returns: list[float] = field(default_factory=list)
    digests: list[str] = field(default_factory=list)

    def to_json(self) -> str:
        """Return the part as text."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str | bytes) -> PartialCheck:
        """Return the part of :meth:`to_json`.

        Raises:
            ValueError, TypeError, KeyError: when the text is not a part.
        """
        values = json.loads(text)
        return cls(**values | {"findings": [Finding(**finding) for finding in values["findings"]]})


def check(data: Path, metadata: Mapping[str, Any]) -> Findings:
    """Check everything of the Minari storage in the folder ``data`` except the replay of its episodes.

    Args:
        data: the folder with ``main_data.hdf5`` and ``metadata.json``.
        metadata: the content of ``metadata.json``.
    """
    return merge(data, metadata, [check_part(data, metadata)])


def check_part(data: Path, metadata: Mapping[str, Any], number: int = 0, count: int = 1) -> PartialCheck:
    """Check one of ``count`` parts of the storage in the folder ``data``; the first checks the files too."""
    part = PartialCheck()
    try:
        _check(part, data, metadata, number, count)
    except bounded_read.UnreadableError as error:
        part.findings.append(error.finding)
        part.readable = False
    except Exception as error:  # h5py raises any kind of error on a damaged file
        part.findings.append(unreadable(data, error))
        part.readable = False
    return part


def merge(data: Path, metadata: Mapping[str, Any], parts: Sequence[PartialCheck]) -> Findings:
    """Return what the parts found, and what the checks of all episodes together find."""
    findings = Findings((finding for part in parts for finding in part.findings), replayable=False)
    if all(part.readable for part in parts):
        try:
            _check_whole(findings, data, metadata, parts)
        except Exception as error:  # as above
            findings.append(unreadable(data, error))
            findings.replayable = False
    return findings


def unreadable(data: Path, error: Exception) -> Finding:
    """Return the finding for an error in reading a dataset."""
    return Finding(str(data), f"cannot be read: {type(error).__name__}: {str(error)[:200]}")


def _check(part: PartialCheck, data: Path, metadata: Mapping[str, Any], number: int, count: int) -> None:
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
        part.episodes, root = len(files.file), bounded_read.attributes(files.file.id, "")
        for episode in range(part.episodes * number // count, part.episodes * (number + 1) // count):
            _check_episode(part, bounded_read.look(files, episode), episode, root, metadata)
            if len(part.findings) >= MAX_FINDINGS:
                part.sound = False
                return


def _check_episode(
    part: PartialCheck,
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
    if variant is not None and named not in part.identities:
        part.identities.append(named)
    attributes = expected.policy_attributes(episode.attributes)
    if not part.runs or part.runs[-1][1] != attributes:
        part.runs.append((number, attributes))
    part.returns.append(float(episode.attributes["rewards_sum"]))
    part.unreplayed += not structure.is_replayed(episode.attributes)
    part.findings += identity.episode(episode, number, variant, root, metadata)
    changed = list(digests.arrays(episode, read))
    part.findings += changed
    part.intact &= not changed


def _check_whole(
    findings: Findings, data: Path, metadata: Mapping[str, Any], parts: Sequence[PartialCheck]
) -> None:
    """Add the findings of the checks that need all episodes."""
    totals = {"total_episodes": parts[0].episodes, "total_steps": sum(part.steps for part in parts)}
    obstacles = list(differing("metadata.json/", metadata, totals, ", as in the file"))
    findings += obstacles
    named = [named for part in parts for named in part.identities]
    whole = named and all(part.sound for part in parts)
    if obstacles or any(identity.loadable(metadata)) or not whole:
        return
    with h5py.File(file_format.main_file(data), "r") as file:
        root = bounded_read.attributes(file.id, "")
    sealed = [digest for part in parts for digest in part.digests]
    content = Content(
        identities=list(dict.fromkeys((variant_of(one), one["tier"]) for one in named)),
        episodes=len(sealed),
        runs=[run for part in parts for run in part.runs],
        unreplayed=sum(part.unreplayed for part in parts),
        returns=[value for part in parts for value in part.returns],
        repeated=len(sealed) - len(set(sealed)),
    )
    findings += identity.whole(root, metadata, content)
    known = expected.known(metadata, content)
    findings += expected.compare(metadata, content, known)
    findings.exceptions = tuple(expected.exceptions(metadata, content, known))
    if all(part.intact for part in parts):
        findings += digests.whole(sealed, root, metadata, all(part.linked for part in parts))
    findings.replayable = True
