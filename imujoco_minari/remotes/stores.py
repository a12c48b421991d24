"""What pushing and pulling ask of a remote, and how its errors are told.

A store is Minari's own ``CloudStorage`` of the remote with another way of uploading and downloading, so
that what shows on a remote is whole.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from imujoco_minari.errors import ImujocoError, RemoteError
from imujoco_minari.storage.file_format import MAIN_FILE
from imujoco_minari.storage.minari_root import NAMESPACE_FILE

METADATA_FILE = "data/metadata.json"
# The files of a dataset in the order in which they are written: Minari lists what has a metadata.json.
FILES = (f"data/{MAIN_FILE}", METADATA_FILE)
CARD = "README.md"


class Store(Protocol):
    """A remote. Paths are relative to it: ``imujoco/hopper-base-v0/data/metadata.json``."""

    shows_cards: bool
    """Whether the remote has a page for a namespace, made of its card."""

    def read(self, path: str) -> bytes | None:
        """Return the content of a small file as it is now, or None when there is none."""

    def registered(self, namespace: str, dataset_id: str) -> bool:
        """Return whether stock Minari would list a dataset whose metadata is there."""

    def holds(self, dataset_id: str) -> bool:
        """Return whether the remote states, for every file of a dataset, the digest of the local file."""

    def upload_namespace(self, namespace: str) -> None:
        """Upload the local metadata of a namespace that the remote does not have."""

    def upload_dataset(self, dataset_id: str, card: str | None = None) -> None:
        """Upload a local dataset with its card so that it shows when it is whole, and not before."""

    def upload_card(self, namespace: str, card: str) -> None:
        """Replace the card of a namespace."""

    def download_dataset(self, dataset_id: str, path: Path) -> None:
        """Download the files of a dataset, and nothing else, below ``path/<dataset_id>``."""

    def list_datasets(self, prefix: str | None = None) -> Iterator[str]:
        """Yield the ids of the datasets that stock Minari would list."""


def metadata(store: Store, dataset_id: str) -> dict[str, Any] | None:
    """Return the metadata of a dataset that stock Minari would list, or None when it would list none."""
    if not store.registered(dataset_id.partition("/")[0], dataset_id):
        return None
    data = store.read(f"{dataset_id}/{METADATA_FILE}")
    return None if data is None else parse_object(data, f"{dataset_id}/{METADATA_FILE}")


def parse_object(data: bytes, name: str) -> dict[str, Any]:
    """Return the JSON object written in a remote file.

    Raises:
        RemoteError: when it holds none.
    """
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, dict):
        raise RemoteError(f"{name} on the remote is no JSON object")
    return value


def sources_of(stated: Mapping[str, Any]) -> list[str]:
    """Return the ids of the datasets that a dataset's metadata says it is made of."""
    sources = stated.get("combined_datasets")
    return [source for source in sources if isinstance(source, str)] if isinstance(sources, list) else []


def namespaces(dataset_id: str) -> list[str]:
    """Return the namespaces around a dataset, the outermost first."""
    parts = dataset_id.split("/")[:-1]
    return ["/".join(parts[: depth + 1]) for depth in range(len(parts))]


def namespace_file(namespace: str) -> str:
    """Return the path of a namespace's metadata on a remote."""
    return f"{namespace}/{NAMESPACE_FILE}"


@contextmanager
def explained(address: str) -> Iterator[None]:
    """Turn what a remote's libraries raise into one line that says what can be done about it."""
    try:
        yield
    except (ImujocoError, AssertionError, AttributeError, LookupError, TypeError):
        raise
    except Exception as error:  # requests, httpx, google.auth and hf_xet have no error in common
        raise RemoteError(f"{address}: {_explanation(address, error)}") from error


_REASONS: Mapping[int, str] = {
    401: "the token is missing or not accepted",
    403: "the token does not allow this",
    412: "someone else wrote at the same time; push again",
    429: "the remote asks to slow down; wait and push again, what is there already is skipped",
}


def _explanation(address: str, error: Exception) -> str:
    status = _status(error)
    if status == 404:
        return (
            "there is no such bucket; make it first, as with `gcloud storage buckets create gs://<bucket>`"
            if address.startswith("gcp://")
            else "there is no such user, organisation or repository, or the token may not see it"
        )
    lines = str(error).strip().splitlines()
    said = f"{type(error).__name__}: {lines[0][:200]}" if lines else type(error).__name__
    if status is not None and status in _REASONS:
        return f"{_REASONS[status]} ({said})"
    if any("connect" in type(each).__name__.lower() for each in (error, error.__cause__)):
        return f"cannot be reached ({said})"
    return said


def _status(error: Exception) -> int | None:
    """Return the HTTP status behind an error of ``google.api_core`` or ``huggingface_hub``."""
    response = getattr(error, "response", None)
    status = getattr(error, "code", None) or getattr(response, "status_code", None)
    return int(status) if isinstance(status, int) else None
