"""``gcp://bucket``: Google Cloud Storage, or an emulator of it named by ``STORAGE_EMULATOR_HOST``.

Minari lists whatever has a ``metadata.json``, so that file is written last. A file that is there with the
same digest is not written again, which is what makes an interrupted push go on where it was.
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
    """Minari's Google Cloud Storage, writing in an order and reading no more than a dataset's files."""

    shows_cards = False

    @classmethod
    def connect(cls, name: str, token: str | None, writing: bool) -> BucketStore:
        """Return the bucket ``name``, with the service account key file ``token`` or that of the environment.

        Raises:
            RemoteError: when the key file is missing or unreadable.
        """
        token = token or os.environ.get(_KEY_FILE)
        if "STORAGE_EMULATOR_HOST" in os.environ:
            token = None
        elif token is None and writing:
            raise RemoteError(
                f"gcp://{name}: no credentials: give the path of a service account's key file with --token, "
                f"or in {_KEY_FILE}"
            )
        if token is not None and not Path(token).is_file():
            raise RemoteError(f"gcp://{name}: there is no key file at {token}")
        try:
            store = cls(name, token)
        except ValueError as error:
            raise RemoteError(f"gcp://{name}: {token} is no service account's key file: {error}") from error
        if writing:
            # Any listing tells a missing bucket; asking for the bucket itself takes one more permission.
            next(iter(store.bucket.list_blobs(max_results=1)), None)
        return store

    def read(self, path: str) -> bytes | None:
        """Return the content of an object, or None when there is none."""
        try:
            data: bytes = self.bucket.blob(path).download_as_bytes()
        except NotFound:
            return None
        return data

    def registered(self, namespace: str, dataset_id: str) -> bool:
        """Return True: Minari lists every dataset in a bucket that has metadata."""
        return True

    def holds(self, dataset_id: str) -> bool:
        """Return whether the bucket states, for every file of a dataset, the digest of the local file."""
        return all(self._holds(f"{dataset_id}/{name}", dataset_folder(dataset_id) / name) for name in FILES)

    def upload_dataset(self, dataset_id: str, card: str | None = None) -> None:
        """Upload a dataset, its ``metadata.json`` last."""
        if card is not None:
            self.bucket.blob(f"{dataset_id}/{CARD}").upload_from_string(card, "text/markdown; charset=utf-8")
        for name in FILES:
            file = dataset_folder(dataset_id) / name
            if not self._holds(f"{dataset_id}/{name}", file):
                self.bucket.blob(f"{dataset_id}/{name}").upload_from_filename(str(file), checksum="md5")

    def upload_card(self, namespace: str, card: str) -> None:
        """Replace the card of a namespace."""
        self.bucket.blob(f"{namespace}/{CARD}").upload_from_string(card, "text/markdown; charset=utf-8")

    def download_dataset(self, dataset_id: str, path: Path) -> None:
        """Download the files of a dataset by their names, so that no other name can lead out of ``path``."""
        for name in FILES:
            target = path / dataset_id / name
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                self.bucket.blob(f"{dataset_id}/{name}").download_to_filename(str(target))
            except NotFound:
                raise RemoteError(f"gcp://{self.bucket.name}: {dataset_id} has no {name}") from None

    def _holds(self, path: str, file: Path) -> bool:
        blob = self.bucket.get_blob(path)
        return blob is not None and blob.md5_hash == _md5(file)


def _md5(file: Path) -> str:
    """Return a file's MD5 as Google Cloud Storage writes it; against accidents, not adversaries."""
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, lambda: hashlib.md5(usedforsecurity=False))
    return base64.b64encode(digest.digest()).decode()
