"""``gcp://bucket``: Google Cloud Storage, or the emulator at ``STORAGE_EMULATOR_HOST``.

Minari lists every folder that has a ``metadata.json``, so that file is written last. A file that the bucket
holds with the same digest is not written again, so an interrupted push continues where it stopped.
"""

from __future__ import annotations

import base64
import hashlib
import os
from pathlib import Path

from google.cloud.exceptions import NotFound
from minari.storage.remotes.gcp import GCPStorage

from imujoco_minari.errors import RemoteError
from imujoco_minari.remotes.stores import CARD, FILES
from imujoco_minari.storage.minari_root import dataset_folder

_KEY_FILE = "GOOGLE_APPLICATION_CREDENTIALS"


class BucketStore(GCPStorage):  # type: ignore[misc,unused-ignore]
    """Minari's Google Cloud Storage that writes files in order and reads only a dataset's own files."""

    shows_cards = False

    def read(self, path: str) -> bytes | None:
        """Return the content of an object, or None if it does not exist."""
        try:
            return bytes(self.bucket.blob(path).download_as_bytes())
        except NotFound:
            return None

    def registered(self, dataset_id: str) -> bool:
        """Return True, since Minari lists every dataset of a bucket that has metadata."""
        return True

    def holds(self, dataset_id: str) -> bool:
        """Return whether the bucket's digests of a dataset's files equal those of the local files."""
        folder = dataset_folder(dataset_id)
        return all(self._holds_file(f"{dataset_id}/{name}", folder / name) for name in FILES)

    def upload_dataset(self, dataset_id: str, card: str) -> None:
        """Upload a dataset, its ``metadata.json`` last."""
        self.upload_card(dataset_id, card)
        for name in FILES:
            file = dataset_folder(dataset_id) / name
            if not self._holds_file(f"{dataset_id}/{name}", file):
                self.bucket.blob(f"{dataset_id}/{name}").upload_from_filename(str(file), checksum="md5")

    def upload_card(self, namespace: str, card: str) -> None:
        """Replace the card of a namespace or a dataset."""
        self.bucket.blob(f"{namespace}/{CARD}").upload_from_string(card, "text/markdown; charset=utf-8")

    def download_dataset(self, dataset_id: str, path: Path) -> None:
        """Download the files of a dataset by fixed names, so no name can lead out of ``path``."""
        for name in FILES:
            target = path / dataset_id / name
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                self.bucket.blob(f"{dataset_id}/{name}").download_to_filename(str(target))
            except NotFound:
                raise RemoteError(f"gcp://{self.bucket.name}: {dataset_id} has no {name}") from None

    def _holds_file(self, path: str, file: Path) -> bool:
        blob = self.bucket.get_blob(path)
        return blob is not None and blob.md5_hash == _md5_base64(file)


def connect(name: str, token: str | None, writing: bool) -> BucketStore:
    """Return the store of the bucket ``name``; ``writing`` requires a key file and an existing bucket."""
    token = token or os.environ.get(_KEY_FILE)
    if "STORAGE_EMULATOR_HOST" in os.environ:
        token = None
    elif token is None and writing:
        raise RemoteError(
            f"gcp://{name}: no credentials: give the path of a service account's key file with --token "
            f"or in {_KEY_FILE}"
        )
    if token is not None and not Path(token).is_file():
        raise RemoteError(f"gcp://{name}: no key file at {token}")
    try:
        store = BucketStore(name, token)
    except ValueError as error:
        raise RemoteError(f"gcp://{name}: {token} is not a service account's key file: {error}") from error
    if writing:
        # Listing fails on a missing bucket and needs one permission less than asking for the bucket.
        next(iter(store.bucket.list_blobs(max_results=1)), None)
    return store


def _md5_base64(file: Path) -> str:
    """Return a file's MD5 in Google Cloud Storage's encoding. It detects accidents, not attacks."""
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, lambda: hashlib.md5(usedforsecurity=False))
    return base64.b64encode(digest.digest()).decode()
