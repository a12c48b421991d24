"""A remote for push and pull: from its address to its store, the store's interface, and its errors.

Addresses are Minari's: ``hf://user`` and ``gcp://bucket``. A store is Minari's own ``CloudStorage`` with a
different upload and download, so that a remote shows complete datasets only.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from imujoco_minari.errors import ImujocoError, RemoteError, missing_dependency
from imujoco_minari.storage.file_format import MAIN_FILE
from imujoco_minari.storage.metadata import METADATA_FILE
from imujoco_minari.storage.transactions import NAMESPACE_FILE

METADATA_PATH = f"data/{METADATA_FILE}"
# The files of a dataset in the order of writing. Minari lists folders that have a metadata.json.
FILES = (f"data/{MAIN_FILE}", METADATA_PATH)
CARD = "README.md"

# Kind of an address -> our module, and the package that it needs.
_MODULES = {"hf": ("huggingface", "huggingface_hub"), "gcp": ("gcp", "google-cloud-storage")}
_ADDRESS = re.compile(r"(?P<kind>hf|gcp)://(?P<name>[A-Za-z0-9][-\w.]{0,221})", re.ASCII)


class Store(Protocol):
    """A remote. Paths are relative to it, as in ``imujoco/hopper-base-v0/data/metadata.json``."""

    shows_cards: bool
    """Whether the remote shows the card of a namespace as a page."""

    def read(self, path: str) -> bytes | None:
        """Return the present content of a small file, or None if it does not exist."""

    def registered(self, dataset_id: str) -> bool:
        """Return whether stock Minari lists a dataset that has metadata on the remote."""

    def holds(self, dataset_id: str) -> bool:
        """Return whether the remote's digests of a dataset's files equal those of the local files."""

    def upload_namespace(self, namespace: str) -> None:
        """Upload the metadata of a namespace of the root that the remote lacks."""

    def upload_dataset(self, dataset_id: str, card: str) -> None:
        """Upload a dataset of the root with its card; it becomes visible when it is complete."""

    def upload_card(self, namespace: str, card: str) -> None:
        """Replace the card of a namespace."""

    def download_dataset(self, dataset_id: str, path: Path) -> None:
        """Download the files of a dataset, and nothing else, into ``path/<dataset_id>``."""

    def list_datasets(self, prefix: str | None = None) -> Iterator[str]:
        """Yield the ids of the datasets that stock Minari lists."""


def connect(address: str, *, token: str | None = None, writing: bool = False) -> Store:
    """Return the store at ``address``.

    Args:
        address: ``hf://user`` (or an organisation) or ``gcp://bucket``.
        token: a Hugging Face token, or for ``gcp`` the path of a service account's key file. None reads
            the places that the remote's own tools use.
        writing: require a token now, because something will be uploaded.

    Raises:
        RemoteError: if the address is malformed, or a token is missing or unreadable.
        DependencyError: if the remote's package is not installed.
    """
    kind, name = parse_address(address)
    module, package = _MODULES[kind]
    try:
        connect_store = import_module(f"imujoco_minari.remotes.{module}").connect
    except ImportError as error:
        raise missing_dependency(package, "remote", f"the remote {address}") from error
    with remote_errors(address):
        store: Store = connect_store(name, token, writing)
    return store


def parse_address(address: str) -> tuple[str, str]:
    """Return the kind of a remote, ``hf`` or ``gcp``, and the name of its user or bucket.

    Raises:
        RemoteError: if the address is malformed.
    """
    match = _ADDRESS.fullmatch(address)
    if match is None:
        raise RemoteError(f"malformed remote {address[:80]!r}; valid: hf://<user> or gcp://<bucket>")
    return match["kind"], match["name"]


def metadata(store: Store, dataset_id: str) -> dict[str, Any] | None:
    """Return the metadata of a dataset, or None if stock Minari does not list it."""
    if not store.registered(dataset_id):
        return None
    data = store.read(f"{dataset_id}/{METADATA_PATH}")
    return None if data is None else parse_object(data, f"{dataset_id}/{METADATA_PATH}")


def parse_object(data: bytes, name: str) -> dict[str, Any]:
    """Return the JSON object in the content of a remote file; an error names the file ``name``.

    Raises:
        RemoteError: if the content is not a JSON object.
    """
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, dict):
        raise RemoteError(f"{name} on the remote is not a JSON object")
    return value


def namespace_file(namespace: str) -> str:
    """Return the path of a namespace's metadata on a remote."""
    return f"{namespace}/{NAMESPACE_FILE}"


@contextmanager
def remote_errors(address: str) -> Iterator[None]:
    """Turn errors of a remote's libraries into a RemoteError of one line that says what to do."""
    try:
        yield
    except (ImujocoError, AssertionError, AttributeError, LookupError, TypeError):
        raise
    except Exception as error:  # requests, httpx, google.auth and hf_xet share no base error
        raise RemoteError(f"{address}: {_explain_error(address, error)}") from error


_REASONS: Mapping[int, str] = {
    401: "the token is missing or not accepted",
    403: "the token does not allow this",
    412: "another push wrote at the same time; push again",
    429: "too many requests; wait and run the command again, it skips what is complete",
}


def _explain_error(address: str, error: Exception) -> str:
    # google.api_core states the HTTP status as the code of an error, huggingface_hub in its response.
    status = getattr(error, "code", None) or getattr(getattr(error, "response", None), "status_code", None)
    if status == 404:
        return (
            "no such bucket; create it first, for example with `gcloud storage buckets create gs://<bucket>`"
            if address.startswith("gcp://")
            else "no such user, organisation or repository, or the token does not allow reading it"
        )
    lines = str(error).strip().splitlines()
    summary = f"{type(error).__name__}: {lines[0][:200]}" if lines else type(error).__name__
    if isinstance(status, int) and status in _REASONS:
        return f"{_REASONS[status]} ({summary})"
    if any("connect" in type(each).__name__.lower() for each in (error, error.__cause__)):
        return f"cannot be reached ({summary})"
    return summary
