"""The two remotes over their own libraries: the Hub on loopback, and what a bucket needs to be reached."""

# ruff: noqa: E402 - without the optional packages nothing below can be imported

from __future__ import annotations

import hashlib
import json
import sys
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import minari
import pytest

constants = pytest.importorskip("huggingface_hub.constants")
pytest.importorskip("google.cloud.storage")

from hub_server import TOKEN, Hub, HubServer
from huggingface_hub import DatasetCard

from imujoco_minari import remotes
from imujoco_minari.errors import RemoteError
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.remotes import stores
from imujoco_minari.storage import minari_root

# huggingface_hub 2.4 uses httpx in a way that httpx would have changed.
pytestmark = pytest.mark.filterwarnings("ignore:Use 'content=:DeprecationWarning")

HOPPER = "imujoco/hopper-massdec_25_leggeom-random-v0"
BASE = "imujoco/hopper-base-random-v0"
REMOTE = "hf://user"


def point_at(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Do what ``HF_ENDPOINT`` does, which the library reads when it is imported."""
    monkeypatch.setattr(constants, "ENDPOINT", url)
    monkeypatch.setattr(
        constants, "HUGGINGFACE_CO_URL_TEMPLATE", url + "/{repo_id}/resolve/{revision}/{filename}"
    )


@pytest.fixture
def hub(tmp_path: Path, checked_here: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """A Hub on loopback that ``huggingface_hub`` takes for the real one, and a token for it."""
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    with HubServer() as server:
        point_at(server.url, monkeypatch)
        monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "no token"))
        yield server.hub


def test_stock_minari_reads_what_was_pushed_to_the_hub(
    hub: Hub, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish("hopper-massdec_25_leggeom", tier="random", episodes=1)
    assert remotes.push(HOPPER, REMOTE)[0].uploaded
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "elsewhere"))
    monkeypatch.setenv("MINARI_REMOTE", REMOTE)
    monkeypatch.delenv("HF_TOKEN")
    assert list(minari.list_remote_datasets()) == [HOPPER]
    minari.download_dataset(HOPPER)
    for name in stores.FILES:
        assert (tmp_path / "elsewhere" / HOPPER / name).read_bytes() == (root / HOPPER / name).read_bytes()
    for path in ("README.md", "hopper-massdec_25_leggeom-random-v0/README.md"):
        card = DatasetCard(hub.head("user/imujoco").files[path][0].decode())
        assert card.data.license == "apache-2.0"
        assert card.data.task_categories == ["reinforcement-learning", "robotics"]
        assert card.data.size_categories == ["n<1K"]
        assert {"minari", "imujoco"} <= set(card.data.tags)


def test_each_dataset_is_one_commit_and_the_registry_keeps_the_others(hub: Hub) -> None:
    for variant in ("hopper-massdec_25_leggeom", "hopper-base"):
        publish(variant, tier="random", episodes=1)
    list(remotes.push_all([HOPPER, BASE], REMOTE))
    titles = [commit.title for commit in hub.repositories["user/imujoco"]]
    assert titles[2:] == [f"Add {HOPPER}", f"Add {BASE}", "Describe the datasets"]
    registry = json.loads(hub.head("user/imujoco").files["namespace_metadata.json"][0])
    assert registry["datasets"] == [BASE, HOPPER]


def test_a_push_that_is_cut_off_shows_nothing_and_uploads_no_file_twice(hub: Hub) -> None:
    publish("hopper-base", tier="random", episodes=1)
    stores.connect(REMOTE, writing=True).upload_namespace("imujoco")
    hub.fail_once_on = "/commit/"
    with pytest.raises(RemoteError, match="the token does not allow this"):
        remotes.push(BASE, REMOTE)
    assert minari.list_remote_datasets(remote_path=REMOTE) == {}
    assert remotes.push(BASE, REMOTE)[0].uploaded
    assert sum(request.startswith("PUT /upload/") for request in hub.requests) == 1
    assert [outcome.uploaded for outcome in remotes.push(BASE, REMOTE)] == [False]


def test_a_large_file_is_compared_without_reading_it_whole(tmp_path: Path) -> None:
    from imujoco_minari.remotes.huggingface import _is_equal

    file, zeros = tmp_path / "file", bytes(2**23)
    file.write_bytes(zeros)
    blob = hashlib.sha1(b"blob %d\0" % len(zeros) + zeros).hexdigest()
    large = SimpleNamespace(lfs=SimpleNamespace(sha256=hashlib.sha256(zeros).hexdigest()), blob_id="pointer")
    tracemalloc.start()
    assert _is_equal(file, large)
    assert _is_equal(file, SimpleNamespace(lfs=None, blob_id=blob))
    assert not _is_equal(file, SimpleNamespace(lfs=None, blob_id=large.lfs.sha256))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**20


def test_another_push_in_between_loses_no_registration(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    publish("hopper-base", tier="random", episodes=1)
    store = stores.connect(REMOTE, writing=True)
    store.upload_namespace("imujoco")
    commit, raced = type(store)._commit, []

    def race(self: object, repository: str, files: dict[str, object], message: str, parent: str) -> None:
        if not raced:
            raced.append(message)
            hub.commit(
                "user/imujoco",
                "another",
                {"namespace_metadata.json": (b'{"datasets": ["imujoco/x-v0"]}', False)},
            )
        commit(self, repository, files, message, parent)

    monkeypatch.setattr(type(store), "_commit", race)
    store.upload_dataset(BASE, "")
    registry = json.loads(hub.head("user/imujoco").files["namespace_metadata.json"][0])
    assert registry["datasets"] == [BASE, "imujoco/x-v0"]


@pytest.mark.parametrize("registry", [b'{"datasets": 5}', b'{"datasets": [5]}', b"[]", b"{"])
def test_a_damaged_registry_is_one_line(hub: Hub, registry: bytes) -> None:
    publish("hopper-base", tier="random", episodes=1)
    stores.connect(REMOTE, writing=True).upload_namespace("imujoco")
    hub.commit("user/imujoco", "damage", {"namespace_metadata.json": (registry, False)})
    for act in (remotes.push, remotes.pull):
        with pytest.raises(RemoteError, match=r"imujoco/namespace_metadata\.json on the remote"):
            act("imujoco/hopper-other-v0" if act is remotes.pull else BASE, REMOTE)


def test_a_hub_that_cannot_be_reached_is_not_an_empty_one(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    publish("hopper-base", tier="random", episodes=1)
    remotes.push(BASE, REMOTE)
    point_at("http://127.0.0.1:1", monkeypatch)
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    with pytest.raises(RemoteError, match="cannot be reached"):
        remotes.pull("imujoco/hopper-other-v0", REMOTE)


@pytest.mark.parametrize(
    ("token", "remote", "message"),
    [
        (
            None,
            REMOTE,
            r"hf://user: no token: log in with `hf auth login`, set HF_TOKEN, or give one with --token",
        ),
        ("wrong", REMOTE, "the token is missing or not accepted"),
        (TOKEN, "hf://other", "the token does not allow this"),
    ],
)
def test_a_hub_that_refuses_says_why(
    hub: Hub, token: str | None, remote: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish("hopper-base", tier="random", episodes=1)
    monkeypatch.delenv("HF_TOKEN")
    with pytest.raises(RemoteError, match=message):
        remotes.push(BASE, remote, token=token)
    assert not minari_root.dataset_folder(BASE).joinpath("README.md").exists()


@pytest.mark.parametrize(
    ("token", "message"),
    [
        (None, "no credentials: give the path of a service account's key file with --token"),
        ("no such file", "no key file at no such file"),
        (__file__, "is not a service account's key file"),
    ],
)
def test_a_bucket_asks_for_a_key_file(
    token: str | None, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("STORAGE_EMULATOR_HOST", "GOOGLE_APPLICATION_CREDENTIALS"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(RemoteError, match=f"gcp://bucket: .*{message}"):
        stores.connect("gcp://bucket", token=token, writing=True)


def test_reading_needs_neither_token_nor_key(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HF_TOKEN", "STORAGE_EMULATOR_HOST", "GOOGLE_APPLICATION_CREDENTIALS"):
        monkeypatch.delenv(name, raising=False)
    assert stores.connect(REMOTE).read("imujoco/nothing") is None
    assert type(stores.connect("gcp://bucket")).__name__ == "BucketStore"
    assert "imujoco_minari.remotes.gcp" in sys.modules
