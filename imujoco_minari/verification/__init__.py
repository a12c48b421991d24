"""Is a dataset what it says it is? Structure, attributes, digests, and a replay of every episode.

The replay resets the variant's environment with each recorded seed, applies the recorded actions and
compares every observation, reward and flag, bit for bit. It is exact only under the MuJoCo version
and on the processor architecture that made the dataset; another version is itself a finding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import h5py

from imujoco_minari import content, roots
from imujoco_minari.errors import DatasetNotFoundError
from imujoco_minari.verification import digests, screening, structure
from imujoco_minari.verification.findings import MAX_FINDINGS, Finding, shown
from imujoco_minari.verification.identity import identity, loadable, original_models, read_metadata
from imujoco_minari.verification.replay import replay

__all__ = ["Finding", "inspect", "verify"]


def verify(
    dataset_id: str, *, replay: bool = True, on_episode: Callable[[], None] | None = None
) -> list[Finding]:
    """Check a dataset of the Minari root and return what is wrong with it; an empty list is good news.

    Args:
        dataset_id: a dataset that this package published, or a collection of such.
        replay: replay every episode, beside the checks of structure, attributes and digests.
        on_episode: called after each episode that was replayed.

    Raises:
        DatasetNotFoundError: when the root holds no such dataset.
    """
    folder = roots.dataset_folder(dataset_id)
    if not folder.exists():
        raise DatasetNotFoundError(
            f"{dataset_id} is not in the Minari root, at {folder}; see `minari list local`"
        )
    data = folder / "data"
    fatal = screening.survives(data)
    if fatal is not None:
        return [fatal]
    findings = inspect(data, replay_episodes=None if replay else 0, on_episode=on_episode)
    stated = read_metadata(data).get("dataset_id")
    if stated != dataset_id:
        findings.insert(
            0,
            Finding(
                "metadata.json/dataset_id", f"is {shown(stated)}, but the dataset lies under {dataset_id!r}"
            ),
        )
    return findings


def inspect(
    data: Path, *, replay_episodes: int | None = None, on_episode: Callable[[], None] | None = None
) -> list[Finding]:
    """Check the Minari storage in the folder ``data`` and return what is wrong with it.

    Args:
        data: the folder with ``main_data.hdf5`` and ``metadata.json``.
        replay_episodes: how many episodes to replay; None for all.
        on_episode: called after each episode that was replayed.
    """
    findings: list[Finding] = []
    checks = _checks(data, replay_episodes, on_episode)
    try:
        for finding in checks:
            findings.append(finding)
            if len(findings) >= MAX_FINDINGS:
                findings.append(Finding(str(data), f"stopped after {MAX_FINDINGS} findings"))
                break
    except Exception as error:  # h5py raises anything at all on a damaged file; none of it is ours
        findings.append(Finding(str(data), f"cannot be read: {type(error).__name__}: {str(error)[:200]}"))
    return findings


def _checks(
    data: Path, replay_episodes: int | None, on_episode: Callable[[], None] | None
) -> Iterator[Finding]:
    for name in ("metadata.json", content.MAIN_FILE):
        if not (data / name).is_file():
            yield Finding(name, "is missing")
            return
    metadata = read_metadata(data)
    if not metadata:
        yield Finding("metadata.json", "is no JSON object")
        return
    yield from digests.files(data, metadata)
    unloadable = list(loadable(metadata))
    yield from unloadable
    with h5py.File(content.main_file(data), "r") as file:
        unreadable = list(structure.readable(file, data))
        yield from unreadable
        if unreadable:
            return
        broken = list(structure.episodes(file, metadata))
        yield from broken
        if broken or unloadable:
            return
        yield from identity(file, metadata)
        yield from digests.arrays(file, metadata)
        count = len(file) if replay_episodes is None else min(replay_episodes, len(file))
        yield from replay(file, range(count), original_models(metadata), on_episode)
