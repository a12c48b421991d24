"""From a remote into the Minari root: download into staging, check, commit.

What comes from elsewhere is not trusted: only the files of a dataset are fetched, a child process reads
them first, and nothing is visible before :mod:`imujoco_minari.verification` found nothing wrong with it.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.errors import DatasetError, DatasetNotFoundError, ImujocoError, NotFoundError
from imujoco_minari.remotes.connecting import connect
from imujoco_minari.remotes.stores import Store, explained, metadata, sources_of
from imujoco_minari.storage import copying, file_format, minari_root
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.verification import Finding, child_process, inspect


@dataclass(frozen=True)
class Pulled:
    """What became of one dataset.

    Attributes:
        dataset_id: the dataset's id.
        remote: address of the remote.
        path: its folder; None when it failed.
        downloaded: whether this call fetched it; False when it was in the root already.
        content_sha256: digest of its arrays; empty for a linked collection, which has none of its own.
        same_simulator: whether the simulator here is the one that made it, so that a replay is exact.
        seconds: wall time.
        error: why it failed; empty when it did not.
        missing: whether it failed because something that was asked for does not exist.
    """

    dataset_id: str
    remote: str
    path: Path | None = None
    downloaded: bool = False
    content_sha256: str = ""
    same_simulator: bool = True
    seconds: float = 0.0
    error: str = ""
    missing: bool = False


def pull(dataset_id: str, remote: str, *, token: str | None = None, force: bool = False) -> list[Pulled]:
    """Download a dataset from a remote, and before it the datasets that it is made of.

    Args:
        dataset_id: a dataset that this package published, or a collection of such.
        remote: ``hf://user`` or ``gcp://bucket``.
        token: a Hugging Face token, or the path of a service account's key file; public data needs none.
        force: replace a dataset of the root that has the id. A dataset that it is made of is not replaced.

    Returns:
        What was downloaded or was there already, the dataset itself last.

    Raises:
        DatasetNotFoundError: when the remote lists no such dataset.
        DatasetError: when what was downloaded is not whole and sound, or the root holds other content under
            the id of a dataset that it is made of; nothing has changed then.
        RemoteError: when the remote cannot be reached or refuses.
    """
    replaceable = {dataset_id} if force else set[str]()
    return list(_pull(connect(remote, token=token), dataset_id, remote, replaceable, set()))


def pull_all(
    dataset_ids: Sequence[str], remote: str, *, token: str | None = None, force: bool = False
) -> Iterator[Pulled]:
    """Download many datasets and yield each outcome as it comes, failures included.

    Raises:
        RemoteError: when the remote's address or token is of no use.
    """
    store = connect(remote, token=token)
    done: set[str] = set()
    for dataset_id in dict.fromkeys(dataset_ids):
        try:
            yield from _pull(store, dataset_id, remote, set(dataset_ids) if force else set(), done)
        except ImujocoError as error:
            yield Pulled(dataset_id, remote, error=str(error), missing=isinstance(error, NotFoundError))


def _pull(
    store: Store, dataset_id: str, remote: str, replaceable: AbstractSet[str], done: set[str]
) -> Iterator[Pulled]:
    """Pull a dataset and what it is made of: all of them are checked before the first is visible.

    Args:
        store: the remote.
        dataset_id: the dataset's id.
        remote: the remote's address.
        replaceable: ids of datasets that may be replaced.
        done: ids of datasets that were pulled before; those that are pulled now are added.
    """
    if dataset_id in done:
        return
    if minari_root.taken(dataset_id) and dataset_id not in replaceable:
        done.add(dataset_id)
        yield Pulled(dataset_id, remote, minari_root.dataset_folder(dataset_id))
        return
    with minari_root.staging(dataset_id) as folder:
        outcomes = list(_stage(store, dataset_id, remote, replaceable - done, folder, set()))
        for outcome in outcomes:
            if outcome.downloaded:
                _commit(folder, outcome.dataset_id, outcome.dataset_id in replaceable)
    outcomes = [outcome for outcome in outcomes if outcome.dataset_id not in done]
    done.update(outcome.dataset_id for outcome in outcomes)
    yield from outcomes


def _stage(
    store: Store, dataset_id: str, remote: str, replaceable: AbstractSet[str], folder: Path, seen: set[str]
) -> Iterator[Pulled]:
    """Download a dataset and what it is made of into ``folder``, and check each; ``seen`` ends cycles."""
    start = time.monotonic()
    seen.add(dataset_id)
    target, staged = minari_root.dataset_folder(dataset_id), folder / dataset_id
    with explained(remote):
        stated = metadata(store, dataset_id)
    if stated is None:
        raise DatasetNotFoundError(f"{remote} lists no {dataset_id}; see `minari list remote`")
    if minari_root.exists(dataset_id) and dataset_id not in replaceable:
        digest = file_format.stated_digest(stated)
        if digest is None or digest != file_format.stated_digest(read_metadata(target / "data")):
            raise DatasetError(
                f"{dataset_id} is needed from {remote}, but the dataset here has other content: nothing was "
                f"replaced; to replace it, run `imujoco pull {dataset_id} --force`"
            )
        # A linked collection refers to its sources by where they lie beside it.
        staged.parent.mkdir(parents=True, exist_ok=True)
        staged.symlink_to(target.resolve())
        yield Pulled(dataset_id, remote, target)
        return
    sources = sources_of(stated)
    for source in sources:
        if source not in seen:
            yield from _stage(store, source, remote, replaceable, folder, seen)
    minari_root.check_place(target)
    with explained(remote):
        store.download_dataset(dataset_id, folder)
    stated = read_metadata(staged / "data")
    # What collections are made of was replayed, or not, when it was pulled.
    same = bool(sources) or _same_simulator(stated)
    findings = _findings(staged / "data", stated, dataset_id, same and not sources)
    if findings:
        raise DatasetError(f"{dataset_id} from {remote}: not kept, its check found: {findings[0]}")
    if dataset_id in replaceable:
        copying.check_replaced(
            dataset_id, file_format.main_file(target / "data"), [file_format.main_file(staged / "data")]
        )
    digest = str(stated.get("content_sha256", ""))
    yield Pulled(dataset_id, remote, target, True, digest, same, time.monotonic() - start)


def _commit(folder: Path, dataset_id: str, replace: bool) -> None:
    """Commit a dataset that lies in ``folder``, from a staging folder that keeps what it replaces."""
    with minari_root.staging(dataset_id) as apart:
        staged = (folder / dataset_id).rename(apart / "dataset")
        minari_root.commit(staged, dataset_id, replace=replace)


def _same_simulator(stated: dict[str, Any]) -> bool:
    """Return whether the simulator and the processor here are as those that made a dataset."""
    theirs = stated.get("versions")
    return (
        isinstance(theirs, dict)
        and {name: version(name) for name in ("mujoco", "gymnasium")}.items() <= theirs.items()
        and stated.get("machine") == platform.machine()
        and stated.get("simd") == np.show_config(mode="dicts")["SIMD Extensions"]["found"]
    )


def _findings(data: Path, stated: dict[str, Any], dataset_id: str, replay: bool) -> list[Finding]:
    fatal = child_process.survives(data)
    if fatal is not None:
        return [fatal]
    if stated.get("dataset_id") != dataset_id:
        return [Finding("metadata.json/dataset_id", f"is {str(stated.get('dataset_id'))[:80]!r}")]
    if replay:
        return inspect(data, replay_episodes=1)
    # Another simulator may write the model otherwise and step it otherwise; the digests still stand.
    findings = inspect(data, replay_episodes=0)
    return [finding for finding in findings if finding.where != "@mjcf" or "digest" in finding.what]
