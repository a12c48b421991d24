"""Checks of a dataset: structure, attributes, metadata, digests, and a replay of every episode.

The replay resets the variant's environment with each recorded seed, applies the recorded actions and
compares every observation, reward and flag, bit for bit. It is exact only with the MuJoCo version and on
the processor architecture that made the dataset; another version is itself a finding.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from imujoco_minari.errors import JobError, whole_number
from imujoco_minari.parallel import run_jobs
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.storage.missing import not_in_root
from imujoco_minari.verification import child_process
from imujoco_minari.verification.check import check, unreadable
from imujoco_minari.verification.findings import MAX_FINDINGS, Finding, Findings, differs
from imujoco_minari.verification.identity import dataset_models
from imujoco_minari.verification.published import compare_with_published, published_entry
from imujoco_minari.verification.replay import actions, replay

__all__ = ["Finding", "Findings", "inspect", "verify"]

# How often a dataset is checked if other processes replace it during the check.
_ATTEMPTS = 3

_OnEpisode = Callable[[], None]


def verify(
    dataset_id: str,
    *,
    replay: bool = True,
    published: bool = False,
    jobs: int = 1,
    backend: str | None = None,
    on_episode: _OnEpisode = lambda: None,
) -> Findings:
    """Check a dataset of the Minari root and return what is wrong with it; an empty list means "sound".

    A dataset is sound if it is what this package makes for its id: variant, tier, model, environment,
    spaces, types, seeds, counts and references agree with each other, no digest differs, and the simulator
    gives every stored value again. The ``exceptions`` of the result state what could not be checked of a
    dataset, for example that it was imported without seeds.

    Args:
        dataset_id: a dataset that this package published, or a collection of such.
        replay: replay every episode, beside the checks of structure, attributes and digests.
        published: also compare the dataset with the digest that this version of the package lists for it.
        jobs: how many processes replay.
        backend: where; see :func:`imujoco_minari.parallel.run_jobs`.
        on_episode: called after each episode that was replayed.

    Raises:
        DatasetNotFoundError: when the root holds no such dataset.
        NotFoundError: with ``published``, when this version lists no digest of the dataset.
        JobError: when the back end cannot be used.
        ArgumentError: when ``jobs`` is not a whole number above 0.

    Example:
        >>> publish("hopper-base", tier="random", episodes=2).dataset_id
        'imujoco/hopper-base-random-v0'
        >>> verify("imujoco/hopper-base-random-v0")
        []
    """
    data = minari_root.dataset_folder(dataset_id) / "data"
    whole_number(jobs, "jobs", least=1)
    # A missing entry fails before the work.
    wanted = published_entry(dataset_id) if published else None
    findings = Findings()
    for _ in range(_ATTEMPTS):
        try:
            before = minari_root.folder_identity(data.parent)
            metadata = read_metadata(data)
            findings = child_process.check_apart(data, metadata, jobs if backend is None else 1)
            if replay and findings.replayable:
                findings += _replayed_by_jobs(data, metadata, jobs, backend, on_episode)
            if metadata.get("dataset_id") != dataset_id:
                stated = metadata.get("dataset_id")
                findings.insert(0, differs("metadata.json/dataset_id", stated, f"{dataset_id!r}, its place"))
            if not findings or before == minari_root.folder_identity(data.parent):
                break
        except (FileNotFoundError, NotADirectoryError):
            raise not_in_root(dataset_id) from None
    if wanted is not None:
        findings += compare_with_published(wanted, metadata)
    findings.clip()
    return findings


def inspect(data: Path, *, replay_episodes: int | None = None, untrusted: bool = False) -> Findings:
    """Check the Minari storage in the folder ``data`` and return what is wrong with it.

    Args:
        data: the folder with ``main_data.hdf5`` and ``metadata.json``.
        replay_episodes: how many episodes to replay; None for all.
        untrusted: read the files in a child process with limits first, as :func:`verify` does.
    """
    metadata = read_metadata(data)
    findings = child_process.check_apart(data, metadata) if untrusted else check(data, metadata)
    if findings.replayable and replay_episodes != 0:
        findings += _replayed(data, metadata, range(metadata["total_episodes"])[:replay_episodes])
    findings.clip()
    return findings


def _replayed(
    data: Path, metadata: Mapping[str, Any], numbers: Sequence[int], on_episode: _OnEpisode = lambda: None
) -> list[Finding]:
    """Replay the numbered episodes of a dataset that was checked; return what differs.

    The share with the first episode also checks the policies' actions.
    """
    findings: list[Finding] = []
    try:
        with h5py.File(file_format.main_file(data), "r") as file:
            if 0 in numbers:
                findings += actions(file, metadata)
            findings += islice(replay(file, numbers, dataset_models(metadata), on_episode), MAX_FINDINGS)
    except Exception as error:  # h5py and the simulator may raise anything on a damaged file
        findings.append(unreadable(data, error))
    return findings


def _replayed_by_jobs(
    data: Path, metadata: Mapping[str, Any], jobs: int, backend: str | None, on_episode: _OnEpisode
) -> list[Finding]:
    """Replay all episodes in shares; return what differs, in the order of the episodes."""
    episodes = metadata["total_episodes"]
    if jobs == 1 and backend is None:
        return _replayed(data, metadata, range(episodes), on_episode)
    # Several shares a job, so that none waits long for another at the end.
    count = min(episodes, 4 * max(jobs, 2) if backend is None else 256)
    shares = [share.tolist() for share in np.array_split(np.arange(episodes), count)]
    found: dict[int, list[Finding]] = {}
    work = partial(_replayed, data.absolute(), metadata)
    for number, findings in run_jobs(work, shares, jobs=jobs, backend=backend):
        share = shares[number]
        if isinstance(findings, JobError):
            first, last = (file_format.episode_name(one) for one in (share[0], share[-1]))
            findings = [Finding(f"{first} to {last}", f"could not be replayed: {findings}")]
        found[number] = findings
        for _ in share:
            on_episode()
    return [finding for number in sorted(found) for finding in found[number]]
