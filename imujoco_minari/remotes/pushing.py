"""From the Minari root to a remote: check, upload, download again, compare."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from imujoco_minari.errors import DatasetError, DatasetExistsError, ImujocoError, RemoteError
from imujoco_minari.publishing.outcome import DatasetOutcome
from imujoco_minari.remotes.card import dataset_card, namespace_card
from imujoco_minari.remotes.stores import (
    FILES,
    METADATA_PATH,
    Store,
    connect,
    metadata,
    namespace_file,
    parse_object,
    remote_errors,
)
from imujoco_minari.storage import minari_root
from imujoco_minari.storage.file_format import file_sha256
from imujoco_minari.storage.metadata import local_collections, read_metadata, sources
from imujoco_minari.storage.missing import not_in_root
from imujoco_minari.verification import verify


@dataclass(frozen=True, repr=False)
class Pushed(DatasetOutcome):
    """The outcome of pushing one dataset.

    Attributes:
        remote: address of the remote.
        uploaded: whether this call uploaded it; False if the remote had the same dataset already.
        bytes: size of its files, in bytes.
        content_sha256: digest of its arrays; empty for a linked collection, which has no arrays.
        seconds: wall time.
    """

    remote: str = ""
    uploaded: bool = False
    bytes: int = 0
    content_sha256: str = field(default="", repr=False)
    seconds: float = 0.0


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
    """Upload many datasets as :func:`push` does. Yield each outcome when it is ready, failures included.

    Raises:
        RemoteError: if the address is malformed, or the token is missing or unreadable.
    """
    for outcome, _ in _push_each(dataset_ids, remote, token, force):
        yield outcome


def plan_push(dataset_ids: Sequence[str]) -> Iterator[Pushed]:
    """Yield what :func:`push_all` would upload to an empty remote, with the sizes. No remote is asked."""
    for outcome, _ in _each_part(
        dataset_ids, "", lambda part: Pushed(part, minari_root.dataset_folder(part), bytes=_size(part))
    ):
        yield outcome


def collections_of(dataset_ids: Sequence[str]) -> list[str]:
    """Return the ids of the collections in the Minari root that combine no other datasets than these."""
    given = set(dataset_ids)
    return [name for name, metadata in local_collections() if set(sources(metadata)) <= given]


def _push_each(
    dataset_ids: Sequence[str], remote: str, token: str | None, force: bool
) -> Iterator[tuple[Pushed, ImujocoError | None]]:
    """Push datasets with their sources, and then update the cards, also after failures."""
    store = connect(remote, token=token, writing=True)
    uploaded: list[str] = []
    replaceable = set(dataset_ids) if force else set[str]()
    push_part = partial(_push_one, store=store, remote=remote, replaceable=replaceable)
    for outcome, error in _each_part(dataset_ids, remote, push_part):
        if outcome.uploaded:
            uploaded.append(outcome.dataset_id)
        yield outcome, error
    _update_cards(store, remote, uploaded)


def _each_part(
    dataset_ids: Sequence[str], remote: str, act: Callable[[str], Pushed]
) -> Iterator[tuple[Pushed, ImujocoError | None]]:
    """Apply ``act`` once to each dataset and its sources. Yield each outcome, and the error of a failure."""
    done: set[str] = set()
    for dataset_id in dict.fromkeys(dataset_ids):
        try:
            for part in _sources_and_itself(dataset_id):
                if part not in done:
                    outcome = act(part)
                    done.add(part)
                    yield outcome, None
        except ImujocoError as error:
            yield Pushed.failed(dataset_id, error, remote=remote), error


def _size(dataset_id: str) -> int:
    """Return the size of the files of a dataset, in bytes."""
    if not minari_root.exists(dataset_id):
        raise not_in_root(dataset_id)
    folder = minari_root.dataset_folder(dataset_id)
    with minari_root.storage_errors(folder):
        return sum((folder / name).stat().st_size for name in FILES)


def _sources_and_itself(dataset_id: str, around: AbstractSet[str] = frozenset()) -> list[str]:
    """Return the sources of a dataset, which Minari downloads with it, and then the dataset.

    The collections ``around`` it are left out, so a cycle ends.
    """
    # The check of the dataset follows and reports metadata that cannot be read.
    combined = sources(read_metadata(minari_root.dataset_folder(dataset_id) / "data"))
    around = {*around, dataset_id}
    parts = [part for each in combined if each not in around for part in _sources_and_itself(each, around)]
    return list(dict.fromkeys([*parts, dataset_id]))


def _push_one(dataset_id: str, store: Store, remote: str, replaceable: AbstractSet[str]) -> Pushed:
    start = time.monotonic()
    findings = verify(dataset_id, replay=False)
    if findings:
        raise DatasetError(f"{dataset_id}: not pushed, because its check found: {findings[0]}")
    folder = minari_root.dataset_folder(dataset_id)
    ours = read_metadata(folder / "data")
    content = str(ours.get("content_sha256", ""))
    pushed = Pushed(dataset_id, folder, remote=remote, bytes=_size(dataset_id), content_sha256=content)
    with remote_errors(remote):
        theirs = metadata(store, dataset_id)
        if theirs == ours and store.holds(dataset_id):
            return replace(pushed, seconds=time.monotonic() - start)
        if theirs is not None and theirs != ours and dataset_id not in replaceable:
            made, other = theirs.get("code_permalink", "unknown"), str(theirs.get("content_sha256"))[:12]
            raise DatasetExistsError(
                f"{remote} has another {dataset_id}, made with {made} with content {other}; "
                f"it was not replaced (`imujoco push {dataset_id} --force` replaces it)"
            )
        for namespace in minari_root.namespaces(dataset_id):
            if store.read(namespace_file(namespace)) is None:
                store.upload_namespace(namespace)
        store.upload_dataset(dataset_id, dataset_card(folder / "data", remote))
        _check_upload(store, dataset_id, folder, remote)
    return replace(pushed, uploaded=True, seconds=time.monotonic() - start)


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
    for namespace in dict.fromkeys(dataset_id.partition("/")[0] for dataset_id in dataset_ids):
        with remote_errors(remote):
            listed = sorted(store.list_datasets(prefix=f"{namespace}/"))
            files = {name: store.read(f"{name}/{METADATA_PATH}") for name in listed}
            found = {name: parse_object(data, name) for name, data in files.items() if data is not None}
            store.upload_card(namespace, namespace_card(namespace, remote, found))
