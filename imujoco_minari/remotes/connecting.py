"""From an address to a store. Addresses are Minari's: ``hf://user`` and ``gcp://bucket``."""

from __future__ import annotations

import re
from importlib import import_module
from typing import cast

from imujoco_minari.errors import RemoteError, missing_dependency
from imujoco_minari.remotes.stores import Store, remote_errors

# Kind of an address -> our module, and the package that it needs.
_MODULES = {"hf": ("huggingface", "huggingface_hub"), "gcp": ("gcp", "google-cloud-storage")}
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
    kind, name = parse_address(address)
    module, package = _MODULES[kind]
    try:
        connect_store = import_module(f"imujoco_minari.remotes.{module}").connect
    except ImportError as error:
        raise missing_dependency(package, "remote", f"the remote {address}") from error
    with remote_errors(address):
        return cast(Store, connect_store(name, token, writing))


def parse_address(address: str) -> tuple[str, str]:
    """Return the kind of a remote, ``hf`` or ``gcp``, and the name of its user or bucket.

    Raises:
        RemoteError: if the address is malformed.
    """
    match = _ADDRESS.fullmatch(address)
    if match is None:
        raise RemoteError(f"malformed remote {address[:80]!r}; valid: hf://<user> or gcp://<bucket>")
    return match["kind"], match["name"]
