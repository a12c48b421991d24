"""From the Minari root to a remote: check, upload, read back, compare."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imujoco_minari.errors import DatasetError, DatasetExistsError, ImujocoError, NotFoundError, RemoteError
from imujoco_minari.remotes.card import dataset_card, namespace_card
from imujoco_minari.remotes.connecting import connect
from imujoco_minari.remotes.stores import (
    FILES,
    METADATA_FILE,
    Store,
    explained,
    metadata,
    namespace_file,
    namespaces,
    parse_object,
    sources_of,
)
from imujoco_minari.storage import minari_root
from imujoco_minari.storage.file_format import file_sha256
from imujoco_minari.verification import verify


@dataclass(frozen=True)
class Pushed:
    """What became of one dataset.

    Attributes:
        dataset_id: the dataset's id.
        remote: address of the remote.
        uploaded: whether this call uploaded it; False when the same dataset was there already.
        bytes: size of its files.
        content_sha256: digest of its arrays; empty for a linked collection, which has none of its own.
        seconds: wall time.
        error: why it failed; empty when it did not.
        missing: whether it failed because something that was asked for does not exist.
    """

    dataset_id: str
    remote: str
    uploaded: bool = False
    bytes: int = 0
    content_sha256: str = ""
    seconds: float = 0.0
    error: str = ""
    missing: bool = False


def push(dataset_id: str, remote: str, *, token: str | None = None, force: bool = False) -> list[Pushed]:
    """Upload a dataset to a remote, and before it the datasets that it is made of.

    Its digests are checked before, and what the remote holds is read back and compared after.

    Args:
        dataset_id: a dataset of the Minari root that this package published, or a collection of such.
        remote: ``hf://user`` or ``gcp://bucket``.
        token: a Hugging Face token, or the path of a service account's key file.
        force: replace a different dataset that has the id on the remote. A dataset that it is made of is
            not replaced.

    Returns:
        What was uploaded or was there already, the dataset itself last.

    Raises:
        DatasetNotFoundError: when the root holds no such dataset.
        DatasetExistsError: when the remote has another dataset under the id.
        DatasetError: when the check finds something wrong.
        RemoteError: when the remote cannot be reached or refuses.
    """
    store = connect(remote, token=token, writing=True)
    outcomes = [
        _push(store, part, remote, force and part == dataset_id) for part in _with_sources(dataset_id)
    ]
    if any(outcome.uploaded for outcome in outcomes):
        _describe(store, remote, [dataset_id])
    return outcomes


def push_all(
    dataset_ids: Sequence[str], remote: str, *, token: str | None = None, force: bool = False
) -> Iterator[Pushed]:
    """Upload many datasets and yield each outcome as it comes, failures included.

    Raises:
        RemoteError: when the remote cannot be reached at all.
    """
    store = connect(remote, token=token, writing=True)
    uploaded: list[str] = []
    done: set[str] = set()
    for dataset_id in dict.fromkeys(dataset_ids):
        try:
            for part in _with_sources(dataset_id):
                if part not in done:
                    outcome = _push(store, part, remote, force and part in dataset_ids)
                    done.add(part)
                    uploaded += [part] if outcome.uploaded else []
                    yield outcome
        except ImujocoError as error:
            yield Pushed(dataset_id, remote, error=str(error), missing=isinstance(error, NotFoundError))
    if uploaded:
        _describe(store, remote, uploaded)


def _with_sources(dataset_id: str, around: AbstractSet[str] = frozenset()) -> list[str]:
    """Return the datasets that one is made of, which Minari downloads with it, and then itself.

    Those in ``around`` are left out: they are made of this one, and it may be made of them.
    """
    file = minari_root.dataset_folder(dataset_id) / METADATA_FILE
    try:
        sources = sources_of(parse_object(file.read_bytes(), str(file)))
    except (OSError, RemoteError):
        # The check that follows says what is wrong with it.
        sources = []
    around = {*around, dataset_id}
    parts = [part for source in sources if source not in around for part in _with_sources(source, around)]
    return list(dict.fromkeys([*parts, dataset_id]))


def _push(store: Store, dataset_id: str, remote: str, force: bool) -> Pushed:
    start = time.monotonic()
    findings = verify(dataset_id, replay=False)
    if findings:
        raise DatasetError(f"{dataset_id}: not pushed, its check found: {findings[0]}")
    folder = minari_root.dataset_folder(dataset_id)
    ours = parse_object((folder / METADATA_FILE).read_bytes(), METADATA_FILE)
    size = sum((folder / name).stat().st_size for name in FILES)
    digest = str(ours.get("content_sha256", ""))
    with explained(remote):
        theirs = metadata(store, dataset_id)
        if theirs == ours and store.holds(dataset_id):
            return Pushed(dataset_id, remote, False, size, digest, time.monotonic() - start)
        if theirs is not None and theirs != ours and not force:
            raise DatasetExistsError(
                f"{remote} has another {dataset_id}, made on {_made_with(theirs)}; it was left alone "
                f"(`imujoco push {dataset_id} --force` replaces it)"
            )
        for namespace in namespaces(dataset_id):
            if store.read(namespace_file(namespace)) is None:
                store.upload_namespace(namespace)
        store.upload_dataset(dataset_id, dataset_card(folder / "data", remote))
        _compare(store, dataset_id, folder, remote)
    return Pushed(dataset_id, remote, True, size, digest, time.monotonic() - start)


def _made_with(metadata: dict[str, Any]) -> str:
    return (
        f"{metadata.get('code_permalink', 'unknown')} with content {str(metadata.get('content_sha256'))[:12]}"
    )


def _compare(store: Store, dataset_id: str, folder: Path, remote: str) -> None:
    """Read a dataset back and raise a RemoteError unless it is what lies in ``folder``, bit for bit."""
    with tempfile.TemporaryDirectory() as temporary:
        store.download_dataset(dataset_id, Path(temporary))
        for name in FILES:
            if file_sha256(Path(temporary) / dataset_id / name) != file_sha256(folder / name):
                raise RemoteError(
                    f"{remote}: {dataset_id}/{name} was read back, and is not what was uploaded; push again"
                )


def _describe(store: Store, remote: str, dataset_ids: Sequence[str]) -> None:
    """Write the cards of the outermost namespaces anew, where the remote shows them."""
    if not store.shows_cards:
        return
    for namespace in dict.fromkeys(namespaces(dataset_id)[0] for dataset_id in dataset_ids):
        with explained(remote):
            files = {
                dataset_id: store.read(f"{dataset_id}/{METADATA_FILE}")
                for dataset_id in sorted(store.list_datasets(prefix=f"{namespace}/"))
            }
            found = {name: parse_object(data, name) for name, data in files.items() if data is not None}
            store.upload_card(namespace, namespace_card(namespace, remote, found))
