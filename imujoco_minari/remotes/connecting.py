"""From an address to a store. Addresses are Minari's: ``hf://user`` and ``gcp://bucket``."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from imujoco_minari.errors import RemoteError, missing_dependency
from imujoco_minari.remotes.stores import Store, remote_errors

_ADDRESS = re.compile(r"(?P<kind>hf|gcp)://(?P<name>[A-Za-z0-9][-\w.]{0,221})", re.ASCII)


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
    match = _ADDRESS.fullmatch(address)
    if match is None:
        raise RemoteError(f"malformed remote {address[:80]!r}; valid: hf://<user> or gcp://<bucket>")
    with remote_errors(address):
        if match["kind"] == "hf":
            with _require_package("huggingface_hub", address):
                from imujoco_minari.remotes.huggingface import HubStore
            return HubStore.connect(match["name"], token, writing)
        with _require_package("google-cloud-storage", address):
            from imujoco_minari.remotes.gcp import BucketStore
        return BucketStore.connect(match["name"], token, writing)


@contextmanager
def _require_package(package: str, address: str) -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        raise missing_dependency(package, "remote", f"the remote {address}") from error
