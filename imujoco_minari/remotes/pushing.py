"""From the Minari root to a remote: check, upload, download again, compare."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from imujoco_minari.errors import DatasetError, DatasetExistsError, ImujocoError, RemoteError
from imujoco_minari.remotes.card import dataset_card, namespace_card
from imujoco_minari.remotes.connecting import connect
from imujoco_minari.remotes.stores import (
    FILES,
    METADATA_PATH,
    Store,
    metadata,
    namespace_file,
    namespaces,
    parse_object,
    remote_errors,
)
from imujoco_minari.short_repr import short_repr
from imujoco_minari.storage import minari_root
from imujoco_minari.storage.file_format import file_sha256
from imujoco_minari.storage.metadata import read_metadata, sources
from imujoco_minari.verification import verify


@dataclass(frozen=True)
class Pushed:
    """The outcome of pushing one dataset.

    Attributes:
        dataset_id: the dataset's id.
        remote: address of the remote.
        uploaded: whether this call uploaded it; False if the remote had the same dataset already.
        bytes: size of its files, in bytes.
        content_sha256: digest of its arrays; empty for a linked collection, which has no arrays.
        seconds: wall time.
        error: why the push failed; empty on success.
        missing: whether it failed because something that was asked for does not exist.
    """

    dataset_id: str
    remote: str
    uploaded: bool = False
    bytes: int = 0
    content_sha256: str = field(default="", repr=False)
    seconds: float = 0.0
    error: str = ""
    missing: bool = False

    __repr__ = short_repr


def push(dataset_id: str, remote: str, *, token: str | None = None, force: bool = False) -> list[Pushed]:
    """Upload a dataset of the Minari root to a remote, with its sources.

    The digests are checked before the upload. Afterwards the files are downloaded again and compared.

    Args:
        dataset_id: a dataset that this package published, or a collection of such datasets.
        remote: ``hf://user`` or ``gcp://bucket``.
        token: a Hugging Face token, or the path of a service account's key file.
        force: replace a different dataset that has this id on the remote. Sources are never replaced.

    Returns:
        One outcome for each source, then the outcome of the dataset itself.

    Raises:
        DatasetNotFoundError: if the root has no such dataset.
        DatasetExistsError: if the remote has a different dataset with this id.
        DatasetError: if the check finds something wrong.
        RemoteError: if the remote cannot be reached or refuses.

    Example:
        >>> push("imujoco/hopper-base-v0", "hf://user")[-1].uploaded
        True
    """
    outcomes = list(_push_each([dataset_id], remote, token, force))
    failed = [error for _, error in outcomes if error is not None]
    if failed:
        raise failed[0]
    return [outcome for outcome, _ in outcomes]


def push_all(
    dataset_ids: Sequence[str], remote: str, *, token: str | None = None, force: bool = False
) -> Iterator[Pushed]:
    """Upload many datasets and yield each outcome when it is ready, failures included.

    Args:
        dataset_ids: the datasets.
        remote: ``hf://user`` or ``gcp://bucket``.
        token: a Hugging Face token, or the path of a service account's key file.
        force: replace different datasets that have these ids on the remote.

    Raises:
        RemoteError: if the address is malformed, or the token is missing or unreadable.
    """
    for outcome, _ in _push_each(dataset_ids, remote, token, force):
        yield outcome


def _push_each(
    dataset_ids: Sequence[str], remote: str, token: str | None, force: bool
) -> Iterator[tuple[Pushed, ImujocoError | None]]:
    """Push datasets with their sources, and then update the cards, also after failures.

    Yields:
        Each outcome, and the error of a failure.
    """
    store = connect(remote, token=token, writing=True)
    uploaded: list[str] = []
    done: set[str] = set()
    for dataset_id in dict.fromkeys(dataset_ids):
        try:
            for part in _sources_and_itself(dataset_id):
                if part not in done:
                    outcome = _push_one(store, part, remote, force and part in dataset_ids)
                    done.add(part)
                    uploaded += [part] if outcome.uploaded else []
                    yield outcome, None
        except ImujocoError as error:
            yield Pushed(dataset_id, remote, error=str(error), missing=error.missing), error
    _update_cards(store, remote, uploaded)


def _sources_and_itself(dataset_id: str, around: AbstractSet[str] = frozenset()) -> list[str]:
    """Return the sources of a dataset, which Minari downloads with it, and then the dataset.

    Args:
        dataset_id: the dataset.
        around: ids of collections that contain it. They are left out, so a cycle ends.
    """
    # The check of the dataset follows and reports metadata that cannot be read.
    combined = sources(read_metadata(minari_root.dataset_folder(dataset_id) / "data"))
    around = {*around, dataset_id}
    parts = [part for each in combined if each not in around for part in _sources_and_itself(each, around)]
    return list(dict.fromkeys([*parts, dataset_id]))


def _push_one(store: Store, dataset_id: str, remote: str, force: bool) -> Pushed:
    start = time.monotonic()
    findings = verify(dataset_id, replay=False)
    if findings:
        raise DatasetError(f"{dataset_id}: not pushed, because its check found: {findings[0]}")
    folder = minari_root.dataset_folder(dataset_id)
    ours = read_metadata(folder / "data")
    size = sum((folder / name).stat().st_size for name in FILES)
    digest = str(ours.get("content_sha256", ""))
    with remote_errors(remote):
        theirs = metadata(store, dataset_id)
        if theirs == ours and store.holds(dataset_id):
            return Pushed(dataset_id, remote, False, size, digest, time.monotonic() - start)
        if theirs is not None and theirs != ours and not force:
            raise DatasetExistsError(
                f"{remote} has another {dataset_id}, made with {_describe_content(theirs)}; "
                f"it was not replaced (`imujoco push {dataset_id} --force` replaces it)"
            )
        for namespace in namespaces(dataset_id):
            if store.read(namespace_file(namespace)) is None:
                store.upload_namespace(namespace)
        store.upload_dataset(dataset_id, dataset_card(folder / "data", remote))
        _check_upload(store, dataset_id, folder, remote)
    return Pushed(dataset_id, remote, True, size, digest, time.monotonic() - start)


def _describe_content(metadata: dict[str, Any]) -> str:
    return (
        f"{metadata.get('code_permalink', 'unknown')} with content {str(metadata.get('content_sha256'))[:12]}"
    )


def _check_upload(store: Store, dataset_id: str, folder: Path, remote: str) -> None:
    """Download a dataset and raise a RemoteError unless it equals ``folder``, bit for bit."""
    with tempfile.TemporaryDirectory() as temporary:
        store.download_dataset(dataset_id, Path(temporary))
        for name in FILES:
            if file_sha256(Path(temporary) / dataset_id / name) != file_sha256(folder / name):
                raise RemoteError(
                    f"{remote}: {dataset_id}/{name} was downloaded again and differs from the upload; "
                    "push again"
                )


def _update_cards(store: Store, remote: str, dataset_ids: Sequence[str]) -> None:
    """Update the cards of the outermost namespaces, if the remote shows cards."""
    if not store.shows_cards:
        return
    for namespace in dict.fromkeys(namespaces(dataset_id)[0] for dataset_id in dataset_ids):
        with remote_errors(remote):
            files = {
                dataset_id: store.read(f"{dataset_id}/{METADATA_PATH}")
                for dataset_id in sorted(store.list_datasets(prefix=f"{namespace}/"))
            }
            found = {name: parse_object(data, name) for name, data in files.items() if data is not None}
            store.upload_card(namespace, namespace_card(namespace, remote, found))
