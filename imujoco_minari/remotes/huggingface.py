"""``hf://user``: a namespace is a dataset repository of a Hugging Face user or organisation.

Minari lists the ids that the repository's ``namespace_metadata.json`` registers. Stock Minari uploads a
dataset and then registers it through a copy in the local cache; an interruption leaves that copy wrong. This
store writes files, card and registration in one commit on a known parent, so a push is complete or absent.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from pathlib import Path
from typing import Any

from huggingface_hub import CommitOperationAdd, get_token
from huggingface_hub.errors import HfHubHTTPError, RemoteEntryNotFoundError, RepositoryNotFoundError
from minari.storage.remotes.huggingface import HuggingFaceStorage

from imujoco_minari.errors import RemoteError
from imujoco_minari.remotes.stores import CARD, FILES, namespace_file, parse_object
from imujoco_minari.storage.file_format import file_sha256
from imujoco_minari.storage.minari_root import dataset_folder
from imujoco_minari.storage.transactions import NAMESPACE_FILE

_ATTEMPTS = 5
_CONFLICTS = (409, 412)


class HubStore(HuggingFaceStorage):  # type: ignore[misc,unused-ignore]
    """Minari's Hugging Face remote that writes in single commits and reads without the local cache."""

    shows_cards = True

    def read(self, path: str, revision: str | None = None) -> bytes | None:
        """Return a file's content, at the head of its repository by default; None if it does not exist."""
        repository, name = self._decompose_path(path)
        # A temporary folder, because stock Minari's cache may differ from the remote.
        with tempfile.TemporaryDirectory() as folder:
            try:
                return self._download_file(repository, name, revision, Path(folder)).read_bytes()
            except (RemoteEntryNotFoundError, RepositoryNotFoundError):
                return None

    def registered(self, dataset_id: str) -> bool:
        """Return whether the repository's namespace metadata names the dataset."""
        return dataset_id in self._registry(self._decompose_path(dataset_id)[0])["datasets"]

    def holds(self, dataset_id: str) -> bool:
        """Return whether the Hub's digests of a dataset's files equal those of the local files."""
        repository, folder = self._decompose_path(dataset_id)
        files = {f"{folder}/{name}": dataset_folder(dataset_id) / name for name in FILES}
        stated = self._api.get_paths_info(self._repo_id(repository), list(files), repo_type="dataset")
        entries = {entry.path: entry for entry in stated}
        return all(path in entries and _is_equal(file, entries[path]) for path, file in files.items())

    def upload_dataset(self, dataset_id: str, card: str) -> None:
        """Upload a dataset's files and card and register its id, in one commit."""
        repository, folder = self._decompose_path(dataset_id)
        files: dict[str, Any] = {f"{folder}/{name}": dataset_folder(dataset_id) / name for name in FILES}
        files[f"{folder}/{CARD}"] = card.encode()
        self._api.create_repo(self._repo_id(repository), repo_type="dataset", exist_ok=True)
        for attempt in range(_ATTEMPTS):
            head = self._api.repo_info(self._repo_id(repository), repo_type="dataset").sha
            try:
                registry = self._registry(repository, head)
                registry["datasets"] = sorted({*registry["datasets"], dataset_id})
                files[NAMESPACE_FILE] = json.dumps(registry).encode()
                self._commit(repository, files, f"Add {dataset_id}", head)
                return
            except HfHubHTTPError as error:
                # Another push was faster. The next attempt reads its registration and keeps it.
                if error.response.status_code not in _CONFLICTS or attempt == _ATTEMPTS - 1:
                    raise

    def upload_card(self, namespace: str, card: str) -> None:
        """Replace the README that the Hub shows on the page of the namespace's repository."""
        repository, folder = self._decompose_path(namespace)
        name = f"{folder}/{CARD}" if folder else CARD
        self._commit(repository, {name: card.encode()}, "Describe the datasets", None)

    def download_dataset(self, dataset_id: str, path: Path) -> None:
        """Download the files of a dataset by fixed names, all from one commit."""
        repository, folder = self._decompose_path(dataset_id)
        head = self._api.repo_info(self._repo_id(repository), repo_type="dataset").sha
        for name in FILES:
            try:
                self._download_file(repository, f"{folder}/{name}", head, path / repository)
            except RemoteEntryNotFoundError:
                raise RemoteError(f"hf://{self.name}: {dataset_id} has no {name}") from None

    def _download_file(self, repository: str, name: str, revision: str | None, folder: Path) -> Path:
        file = self._api.hf_hub_download(
            repo_id=self._repo_id(repository),
            filename=name,
            repo_type="dataset",
            revision=revision,
            local_dir=folder,
        )
        return Path(file)

    def _registry(self, repository: str, revision: str | None = None) -> dict[str, Any]:
        """Return the metadata of a namespace, with the ids that it registers as ``datasets``."""
        name = namespace_file(repository)
        data = self.read(name, revision)
        registry = {} if data is None else parse_object(data, name)
        ids = registry.setdefault("datasets", [])
        if not isinstance(ids, list) or not all(isinstance(each, str) for each in ids):
            raise RemoteError(f"{name} on the remote is damaged: its datasets are not a list of ids")
        return registry

    def _commit(self, repository: str, files: dict[str, Any], message: str, parent: str | None) -> None:
        self._api.create_commit(
            repo_id=self._repo_id(repository),
            repo_type="dataset",
            operations=[CommitOperationAdd(name, content) for name, content in files.items()],
            commit_message=message,
            parent_commit=parent,
        )

    def _repo_id(self, repository: str) -> str:
        return f"{self.name}/{repository}"


def connect(name: str, token: str | None, writing: bool) -> HubStore:
    """Return the store of the user or organisation ``name``; ``writing`` requires a token."""
    token = token or get_token()
    if token is None and writing:
        raise RemoteError(
            f"hf://{name}: no token: log in with `hf auth login`, set HF_TOKEN, or give one with --token"
        )
    return HubStore(name, token)


def _is_equal(file: Path, entry: Any) -> bool:
    """Compare a file with the Hub's entry, which states SHA-256 for a large file, else the git blob id."""
    if entry.lfs:
        return bool(file_sha256(file) == entry.lfs.sha256)
    blob = hashlib.sha1(b"blob %d\0" % file.stat().st_size, usedforsecurity=False)
    with file.open("rb") as stream:
        return bool(hashlib.file_digest(stream, lambda: blob).hexdigest() == entry.blob_id)
