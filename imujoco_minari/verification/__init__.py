"""Checks of a dataset: structure, attributes, metadata, digests, and a replay of every episode.

The replay resets the variant's environment with each recorded seed, applies the recorded actions and
compares every observation, reward and flag, bit for bit. It is exact only with the MuJoCo version and on
the processor architecture that made the dataset; another version is itself a finding.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np

from imujoco_minari.errors import JobError
from imujoco_minari.parallel import run_jobs
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.storage.missing import not_in_root
from imujoco_minari.verification import child_process, digests
from imujoco_minari.verification.check import check, unreadable
from imujoco_minari.verification.findings import MAX_FINDINGS, Checked, Finding, Findings, shown
from imujoco_minari.verification.identity import dataset_models
from imujoco_minari.verification.replay import replay

__all__ = ["Checked", "Finding", "Findings", "check", "inspect", "verify"]

# How often a dataset is checked if other processes replace it during the check.
_ATTEMPTS = 3


def verify(
    dataset_id: str,
    *,
    replay: bool = True,
    jobs: int = 1,
    backend: str | None = None,
    on_episode: Callable[[], None] | None = None,
) -> Findings:
    """Check a dataset of the Minari root and return what is wrong with it; an empty list means "sound".

    A dataset is sound if it is what this package makes for its id: variant, tier, model, environment,
    spaces, types, seeds, counts and references agree with each other, no digest differs, and the simulator
    gives every stored value again. The ``exceptions`` of the result state what could not be checked of a
    dataset, for example that it was imported without seeds.

    Args:
        dataset_id: a dataset that this package published, or a collection of such.
        replay: replay every episode, beside the checks of structure, attributes and digests.
        jobs: how many processes replay.
        backend: where; see :func:`imujoco_minari.parallel.run_jobs`.
        on_episode: called after each episode that was replayed.

    Raises:
        DatasetNotFoundError: when the root holds no such dataset.
        JobError: when the back end cannot be used.
    """
    folder = minari_root.dataset_folder(dataset_id)
    findings = Findings()
    for _ in range(_ATTEMPTS):
        try:
            before = minari_root.folder_identity(folder)
            findings = _check_dataset(dataset_id, folder / "data", replay, jobs, backend, on_episode)
            if not findings or before == minari_root.folder_identity(folder):
                break
        except FileNotFoundError:
            raise not_in_root(dataset_id) from None
    return findings


def _check_dataset(
    dataset_id: str,
    data: Path,
    replay: bool,
    jobs: int,
    backend: str | None,
    on_episode: Callable[[], None] | None,
) -> Findings:
    """Check the dataset that lies in the folder ``data`` now."""
    checked = child_process.checked_apart(data, jobs if backend is None else 1)
    if isinstance(checked, Finding):
        # HDF5 killed or held the child. The digests of the files do not need HDF5.
        metadata = read_metadata(data)
        return Findings([*(digests.files(data, metadata) if metadata else ()), checked])
    findings = checked.findings
    if replay and checked.replayable:
        if jobs == 1 and backend is None:
            findings += _replayed(data, None, on_episode)
        else:
            findings += _replayed_by_jobs(data, jobs, backend, on_episode)
    stated = read_metadata(data).get("dataset_id")
    if stated != dataset_id:
        findings.insert(
            0,
            Finding(
                "metadata.json/dataset_id", f"is {shown(stated)}, but the dataset lies under {dataset_id!r}"
            ),
        )
    return Findings(_first(findings, data), checked.exceptions)


def inspect(
    data: Path, *, replay_episodes: int | None = None, on_episode: Callable[[], None] | None = None
) -> list[Finding]:
    """Check the Minari storage in the folder ``data`` and return what is wrong with it.

    Args:
        data: the folder with ``main_data.hdf5`` and ``metadata.json``.
        replay_episodes: how many episodes to replay; None for all.
        on_episode: called after each episode that was replayed.
    """
    checked = check(data)
    findings = checked.findings
    if checked.replayable and replay_episodes != 0:
        numbers = None if replay_episodes is None else range(replay_episodes)
        findings += _replayed(data, numbers, on_episode)
    return _first(findings, data)


def _replayed(
    data: Path, numbers: range | None, on_episode: Callable[[], None] | None = None
) -> list[Finding]:
    """Replay the numbered episodes of a dataset that was checked, None for all; return what differs."""
    findings: list[Finding] = []
    try:
        with h5py.File(file_format.main_file(data), "r") as file:
            chosen = (
                range(len(file)) if numbers is None else range(numbers.start, min(numbers.stop, len(file)))
            )
            for finding in replay(file, chosen, dataset_models(read_metadata(data)), on_episode):
                findings.append(finding)
                if len(findings) >= MAX_FINDINGS:
                    break
    except Exception as error:  # h5py and the simulator may raise anything on a damaged file
        findings.append(unreadable(data, error))
    return findings


def _replayed_by_jobs(
    data: Path, jobs: int, backend: str | None, on_episode: Callable[[], None] | None
) -> list[Finding]:
    """Replay all episodes in shares, and return what differs in their order."""
    with h5py.File(file_format.main_file(data), "r") as file:
        episodes = len(file)
    # Several shares a job, so that none waits long for another at the end.
    count = min(episodes, 4 * max(jobs, 2) if backend is None else 256)
    bounds = [round(bound) for bound in np.linspace(0, episodes, count + 1)]
    shares = [range(start, stop) for start, stop in pairwise(bounds)]
    found: dict[int, list[Finding]] = {}
    work = partial(_replayed, data.absolute())
    for number, findings in run_jobs(work, shares, jobs=jobs, backend=backend):
        share = shares[number]
        if isinstance(findings, JobError):
            where = f"episode_{share.start} to episode_{share.stop - 1}"
            findings = [Finding(where, f"could not be replayed: {findings}")]
        found[number] = findings
        for _ in share:
            if on_episode is not None:
                on_episode()
    return [finding for number in sorted(found) for finding in found[number]]


def _first(findings: list[Finding], data: Path) -> list[Finding]:
    if len(findings) < MAX_FINDINGS:
        return findings
    return [*findings[:MAX_FINDINGS], Finding(str(data), f"stopped after {MAX_FINDINGS} findings")]
