"""From a remote into the Minari root: download into a staging folder, check, commit.

Downloaded data is not trusted. Only the files of a dataset are fetched, and a child process reads them first.
A dataset becomes visible after :mod:`imujoco_minari.verification` found nothing wrong with it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from imujoco_minari.errors import DatasetError, DatasetNotFoundError, ImujocoError
from imujoco_minari.publishing.outcome import DatasetOutcome
from imujoco_minari.remotes.stores import Store, connect, metadata, remote_errors
from imujoco_minari.storage import copying, file_format, minari_root, transactions
from imujoco_minari.storage.metadata import processor, read_metadata, sources
from imujoco_minari.verification import Finding, inspect
from imujoco_minari.verification.findings import differs


@dataclass(frozen=True, repr=False)
class Pulled(DatasetOutcome):
    """The outcome of pulling one dataset.

    Attributes:
        remote: address of the remote.
        downloaded: whether this call downloaded it; False if the root had it already.
        content_sha256: digest of its arrays; empty for a linked collection, which has no arrays.
        same_simulator: whether this machine has the versions that made it, so a replay is exact.
        seconds: wall time.
    """

    remote: str = ""
    downloaded: bool = False
    content_sha256: str = field(default="", repr=False)
    same_simulator: bool = True
    seconds: float = 0.0


def pull(dataset_id: str, remote: str, *, token: str | None = None, force: bool = False) -> list[Pulled]:
    """Download a dataset from a remote into the Minari root, with its sources.

    Args:
        dataset_id: a dataset that this package published, or a collection of such datasets.
        remote: ``hf://user`` or ``gcp://bucket``.
        token: a Hugging Face token, or the path of a service account's key file. Public data needs none.
        force: replace the dataset of the root that has this id. Sources are never replaced.

    Returns:
        One outcome for each source, then the outcome of the dataset itself.

    Raises:
        DatasetNotFoundError: if the remote lists no such dataset.
        DatasetError: if the download is damaged, or the root has other content under the id of a source.
            The root is unchanged then.
        RemoteError: if the remote cannot be reached or refuses.

    Example:
        >>> pull("imujoco/hopper-base-v0", "hf://user")[-1].downloaded
        True
    """
    replaceable = {dataset_id} if force else set[str]()
    return list(_pull_with_sources(connect(remote, token=token), dataset_id, remote, replaceable, set()))


def pull_all(
    dataset_ids: Sequence[str], remote: str, *, token: str | None = None, force: bool = False
) -> Iterator[Pulled]:
    """Download many datasets as :func:`pull` does. Yield each outcome when it is ready, failures included.

    Raises:
        RemoteError: if the address is malformed or the token is unreadable.
    """
    store = connect(remote, token=token)
    done: set[str] = set()
    replaceable = set(dataset_ids) if force else set[str]()
    for dataset_id in dict.fromkeys(dataset_ids):
        try:
            yield from _pull_with_sources(store, dataset_id, remote, replaceable, done)
        except ImujocoError as error:
            yield Pulled.failed(dataset_id, error, remote=remote)


def _pull_with_sources(
    store: Store, dataset_id: str, remote: str, replaceable: AbstractSet[str], done: set[str]
) -> Iterator[Pulled]:
    """Pull a dataset and its sources. All are checked before the first becomes visible.

    ``done`` has the ids that were pulled before. This function adds those that it pulls.
    """
    if dataset_id in done:
        return
    if transactions.taken(dataset_id) and dataset_id not in replaceable:
        done.add(dataset_id)
        yield Pulled(dataset_id, minari_root.dataset_folder(dataset_id), remote=remote)
        return
    with transactions.staging(dataset_id) as folder:
        outcomes = list(_download_and_check(store, dataset_id, remote, replaceable - done, folder, set()))
        for outcome in outcomes:
            if outcome.downloaded:
                own = outcome.dataset_id
                # Each is committed from a staging folder of its own, which keeps the replaced dataset.
                with transactions.staging(own) as apart:
                    staged = (folder / own).rename(apart / "dataset")
                    transactions.commit(staged, own, replace=own in replaceable)
    outcomes = [outcome for outcome in outcomes if outcome.dataset_id not in done]
    done.update(outcome.dataset_id for outcome in outcomes)
    yield from outcomes


def _download_and_check(
    store: Store, dataset_id: str, remote: str, replaceable: AbstractSet[str], folder: Path, seen: set[str]
) -> Iterator[Pulled]:
    """Download a dataset and its sources into ``folder`` and check each; ``seen`` breaks cycles."""
    start = time.monotonic()
    seen.add(dataset_id)
    target, staged = minari_root.dataset_folder(dataset_id), folder / dataset_id
    with remote_errors(remote):
        stated = metadata(store, dataset_id)
    if stated is None:
        raise DatasetNotFoundError(f"{remote} lists no {dataset_id}; see `minari list remote`")
    if minari_root.exists(dataset_id) and dataset_id not in replaceable:
        digest = file_format.stated_digest(stated)
        if digest is None or digest != file_format.stated_digest(read_metadata(target / "data")):
            raise DatasetError(
                f"{dataset_id} is needed from {remote}, but the dataset here has other content. Nothing was "
                f"replaced. To replace it, run `imujoco pull {dataset_id} --force`"
            )
        # A linked collection refers to its sources by relative paths.
        staged.parent.mkdir(parents=True, exist_ok=True)
        staged.symlink_to(target.resolve())
        yield Pulled(dataset_id, target, remote=remote)
        return
    combined = sources(stated)
    for source in combined:
        if source not in seen:
            yield from _download_and_check(store, source, remote, replaceable, folder, seen)
    minari_root.check_place(target)
    with remote_errors(remote):
        store.download_dataset(dataset_id, folder)
    stated = read_metadata(staged / "data")
    # The sources of a collection were replayed, or not, when they were pulled.
    same = bool(combined) or _has_same_simulator(stated)
    findings = _find_damage(staged / "data", stated, dataset_id, same and not combined)
    if findings:
        raise DatasetError(f"{dataset_id} from {remote}: not kept, because its check found: {findings[0]}")
    if dataset_id in replaceable:
        copying.check_replaced(
            dataset_id, file_format.main_file(target / "data"), [file_format.main_file(staged / "data")]
        )
    yield Pulled(
        dataset_id,
        target,
        remote=remote,
        downloaded=True,
        content_sha256=str(stated.get("content_sha256", "")),
        same_simulator=same,
        seconds=time.monotonic() - start,
    )


def _has_same_simulator(stated: dict[str, Any]) -> bool:
    """Return whether this machine has the versions and the processor that made a dataset."""
    versions = stated.get("versions")
    return (
        isinstance(versions, dict)
        and {name: version(name) for name in ("mujoco", "gymnasium")}.items() <= versions.items()
        and all(stated.get(key) == value for key, value in processor().items())
    )


def _find_damage(data: Path, stated: dict[str, Any], dataset_id: str, replay: bool) -> list[Finding]:
    if stated.get("dataset_id") != dataset_id:
        return [differs("metadata.json/dataset_id", stated.get("dataset_id"), repr(dataset_id))]
    findings = inspect(data, replay_episodes=int(replay), untrusted=True)
    # Another version may write and step the model differently. The digests must still match.
    return [found for found in findings if replay or found.where != "@mjcf" or "digest" in found.what]
