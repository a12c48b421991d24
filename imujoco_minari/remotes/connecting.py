"""How a remote is reached. Addresses are Minari's: ``hf://user`` and ``gcp://bucket``."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from imujoco_minari.errors import RemoteError, missing_dependency
from imujoco_minari.remotes.stores import Store, explained

_ADDRESS = re.compile(r"(?P<kind>hf|gcp)://(?P<name>[A-Za-z0-9][-\w.]{0,221})", re.ASCII)


def connect(address: str, *, token: str | None = None, writing: bool = False) -> Store:
    """Return the store at ``address``.

    Args:
        address: ``hf://user`` (or an organisation) or ``gcp://bucket``.
        token: a Hugging Face token, or the path of a service account's key file for ``gcp``; None looks
            where the remote's own tools do.
        writing: whether something will be uploaded, so that a missing token is told now.

    Raises:
        RemoteError: when the address is malformed, or a token is missing or unreadable.
        DependencyError: when the remote's package is not installed.
    """
    match = _ADDRESS.fullmatch(address)
    if match is None:
        raise RemoteError(f"malformed remote {address[:80]!r}; valid: hf://<user> or gcp://<bucket>")
    with explained(address):
        if match["kind"] == "hf":
            with _installed("huggingface_hub", address):
                from imujoco_minari.remotes.huggingface import HubStore
            return HubStore.connect(match["name"], token, writing)
        with _installed("google-cloud-storage", address):
            from imujoco_minari.remotes.gcp import BucketStore
        return BucketStore.connect(match["name"], token, writing)


@contextmanager
def _installed(package: str, address: str) -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        raise missing_dependency(package, "remote", f"the remote {address}") from error
