"""Pushing and pulling: what is checked, what is refused, and what an interruption leaves."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import pytest

from imujoco_minari import remotes, verification
from imujoco_minari.cli.app import run
from imujoco_minari.errors import (
    DatasetError,
    DatasetExistsError,
    DatasetNotFoundError,
    DependencyError,
    RemoteError,
)
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.remotes import card, pulling, pushing, stores
from imujoco_minari.storage import minari_root, transactions
from imujoco_minari.storage.file_format import MAIN_FILE
from imujoco_minari.verification import inspect

HOPPER = "imujoco/hopper-massdec_25_leggeom-random-v0"
BASE = "imujoco/hopper-base-random-v0"
LINKED = "imujoco/hopper-both-v0"
REMOTE = "gcp://bucket"


class FolderStore:
    """A remote that is a folder, in the layout of a bucket, and can be told to fail."""

    shows_cards = True

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.uploads: list[str] = []
        self.on_upload: Callable[[Path], None] = lambda file: None

    def read(self, path: str) -> bytes | None:
        file = self.folder / path
        return file.read_bytes() if file.is_file() else None

    def registered(self, dataset_id: str) -> bool:
        return True

    def holds(self, dataset_id: str) -> bool:
        ours = minari_root.dataset_folder(dataset_id)
        return all(self.read(f"{dataset_id}/{name}") == (ours / name).read_bytes() for name in stores.FILES)

    def upload_namespace(self, namespace: str) -> None:
        self._put(f"{namespace}/{transactions.NAMESPACE_FILE}", b"{}")

    def upload_dataset(self, dataset_id: str, text: str) -> None:
        self._put(f"{dataset_id}/{stores.CARD}", text.encode())
        for name in stores.FILES:
            self._put(f"{dataset_id}/{name}", (minari_root.dataset_folder(dataset_id) / name).read_bytes())

    def upload_card(self, namespace: str, text: str) -> None:
        self._put(f"{namespace}/{stores.CARD}", text.encode())

    def download_dataset(self, dataset_id: str, path: Path) -> None:
        for name in stores.FILES:
            (path / dataset_id / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(self.folder / dataset_id / name, path / dataset_id / name)

    def list_datasets(self, prefix: str | None = None) -> Iterator[str]:
        for file in self.folder.rglob("metadata.json"):
            yield file.parents[1].relative_to(self.folder).as_posix()

    def _put(self, path: str, data: bytes) -> None:
        file = self.folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
        self.uploads.append(path)
        self.on_upload(file)


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Minari root with two small datasets and a linked collection of them, made once."""
    path = tmp_path_factory.mktemp("published")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(path))
        for variant in ("hopper-massdec_25_leggeom", "hopper-base"):
            publish(variant, tier="random", episodes=2)
        combine_datasets([HOPPER, BASE], LINKED, link=True)
    return path


@pytest.fixture
def store(
    published: Path, root: Path, tmp_path: Path, checked_here: None, monkeypatch: pytest.MonkeyPatch
) -> FolderStore:
    """A folder as the remote, and a root that holds what was published."""
    shutil.copytree(published, root)
    store = FolderStore(tmp_path / "remote")
    for module in (pushing, pulling):
        monkeypatch.setattr(module, "connect", lambda *args, **kwargs: store)
    return store


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Path]:
    """Move on to another machine: an empty Minari root."""

    def move() -> Path:
        path = tmp_path / "elsewhere"
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(path))
        return path

    return move


def files(root: Path, dataset_id: str) -> dict[str, bytes]:
    return {name: (root / dataset_id / name).read_bytes() for name in stores.FILES}


def edit_metadata(path: Path, **values: Any) -> None:
    metadata = json.loads(path.read_text())
    path.write_text(json.dumps(metadata | values))


def test_what_is_pulled_is_what_was_pushed(
    store: FolderStore, root: Path, elsewhere: Callable[[], Path]
) -> None:
    (pushed,) = remotes.push(HOPPER, REMOTE)
    there = elsewhere()
    (pulled,) = remotes.pull(HOPPER, REMOTE)
    assert pushed.uploaded
    assert pulled.downloaded
    assert pulled.same_simulator
    assert pulled.content_sha256 == pushed.content_sha256 != ""
    assert files(there, HOPPER) == files(root, HOPPER)
    assert pulled.path == there / HOPPER
    assert sorted(path.name for path in there.iterdir()) == ["imujoco"]


def test_the_namespace_comes_first_and_the_metadata_last(store: FolderStore) -> None:
    remotes.push(HOPPER, REMOTE)
    assert store.uploads[0] == "imujoco/namespace_metadata.json"
    assert store.uploads[-2:] == [f"{HOPPER}/data/metadata.json", "imujoco/README.md"]


def test_a_linked_collection_takes_its_sources_with_it_both_ways(
    store: FolderStore, elsewhere: Callable[[], Path]
) -> None:
    assert [outcome.dataset_id for outcome in remotes.push(LINKED, REMOTE)] == [HOPPER, BASE, LINKED]
    there = elsewhere()
    assert [outcome.dataset_id for outcome in remotes.pull(LINKED, REMOTE)] == [HOPPER, BASE, LINKED]
    with h5py.File(there / LINKED / "data" / MAIN_FILE) as file:
        assert [file[f"episode_{i}"].attrs["variant"] for i in (0, 3)] == [
            "hopper-massdec_25_leggeom",
            "hopper-base",
        ]


def test_pushing_again_leaves_the_same_alone_and_refuses_another(store: FolderStore) -> None:
    remotes.push(HOPPER, REMOTE)
    count = len(store.uploads)
    assert [outcome.uploaded for outcome in remotes.push(HOPPER, REMOTE)] == [False]
    assert len(store.uploads) == count
    publish("hopper-massdec_25_leggeom", tier="random", episodes=1, force=True)
    with pytest.raises(DatasetExistsError, match=f"another {HOPPER}.*--force"):
        remotes.push(HOPPER, REMOTE)
    assert len(store.uploads) == count
    assert remotes.push(HOPPER, REMOTE, force=True)[0].uploaded
    assert store.holds(HOPPER)


def test_a_damaged_dataset_is_not_pushed(store: FolderStore, root: Path) -> None:
    with h5py.File(root / HOPPER / "data" / MAIN_FILE, "a") as file:
        file["episode_0/actions"][0] += 1
    with pytest.raises(DatasetError, match="not pushed, because its check found"):
        remotes.push(HOPPER, REMOTE)
    assert store.uploads == []


def test_damage_on_the_way_is_found_when_read_back_and_mended_by_pushing_again(store: FolderStore) -> None:
    def damage(file: Path) -> None:
        if file.name == MAIN_FILE:
            file.write_bytes(file.read_bytes()[:-1] + b"?")

    store.on_upload = damage
    with pytest.raises(RemoteError, match=f"{MAIN_FILE} was downloaded again and differs from the upload"):
        remotes.push(HOPPER, REMOTE)
    store.on_upload = lambda file: None
    assert remotes.push(HOPPER, REMOTE)[0].uploaded


def test_an_interrupted_push_shows_nothing_and_goes_on(store: FolderStore) -> None:
    def interrupt(file: Path) -> None:
        if file.name == MAIN_FILE:
            raise KeyboardInterrupt

    store.on_upload = interrupt
    with pytest.raises(KeyboardInterrupt):
        remotes.push(HOPPER, REMOTE)
    assert list(store.list_datasets()) == []
    store.on_upload = lambda file: None
    remotes.push(HOPPER, REMOTE)
    assert list(store.list_datasets()) == [HOPPER]


@pytest.mark.parametrize("all_of_them", [False, True])
def test_cards_describe_what_was_uploaded_before_a_failure(store: FolderStore, all_of_them: bool) -> None:
    """Its sources are uploaded, the collection is refused."""
    remotes.push(LINKED, REMOTE)
    edit_metadata(store.folder / LINKED / stores.METADATA_PATH, tier="expert")
    for name in (HOPPER, BASE):
        shutil.rmtree(store.folder / name)
    card = store.folder / "imujoco" / stores.CARD
    card.unlink()
    if all_of_them:
        assert [bool(outcome.error) for outcome in remotes.push_all([LINKED], REMOTE)] == [False, False, True]
    else:
        with pytest.raises(DatasetExistsError):
            remotes.push(LINKED, REMOTE)
    assert HOPPER in card.read_text()


def test_odd_metadata_on_the_remote_does_not_stop_the_card(store: FolderStore) -> None:
    remotes.push(HOPPER, REMOTE)
    edit_metadata(store.folder / HOPPER / stores.METADATA_PATH, author=5, total_steps="x", license=[])
    assert remotes.push(BASE, REMOTE)[0].uploaded
    assert f"| `{HOPPER}` | 2 | 0 |" in (store.folder / "imujoco" / stores.CARD).read_text()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: (data / MAIN_FILE).write_bytes(b"not HDF5"), "check found"),
        (lambda data: edit_metadata(data / "metadata.json", tier="expert"), "has changed"),
        (
            lambda data: edit_metadata(data / "metadata.json", dataset_id=BASE),
            "dataset_id: is 'imujoco/hopper-base",
        ),
        (
            lambda data: edit_metadata(data / "metadata.json", env_spec='{"entry_point": "os:system"}'),
            "check found",
        ),
    ],
)
def test_what_is_damaged_on_the_remote_is_not_kept(
    store: FolderStore, elsewhere: Callable[[], Path], damage: Callable[[Path], None], message: str
) -> None:
    remotes.push(HOPPER, REMOTE)
    damage(store.folder / HOPPER / "data")
    there = elsewhere()
    with pytest.raises(DatasetError, match=message):
        remotes.pull(HOPPER, REMOTE)
    assert not minari_root.exists(HOPPER)
    assert list(there.rglob("*.hdf5")) == []


def test_data_of_another_simulator_is_kept_and_said_to_be(
    store: FolderStore, elsewhere: Callable[[], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    remotes.push(HOPPER, REMOTE)
    elsewhere()
    monkeypatch.setattr(pulling, "version", lambda name: "0.0.1")
    (pulled,) = remotes.pull(HOPPER, REMOTE)
    assert pulled.downloaded
    assert not pulled.same_simulator


def test_a_collection_of_another_simulator_is_kept_too(
    store: FolderStore, elsewhere: Callable[[], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    remotes.push(LINKED, REMOTE)
    elsewhere()
    monkeypatch.setattr(pulling, "version", lambda name: "0.0.1")
    monkeypatch.setattr(pulling, "inspect", refuse_replays)
    assert [outcome.same_simulator for outcome in remotes.pull(LINKED, REMOTE)] == [False, False, True]


def refuse_replays(data: Path, *, replay_episodes: int | None = None, untrusted: bool) -> list[Any]:
    return inspect(data, replay_episodes=replay_episodes) if replay_episodes == 0 else ["replayed"]


@pytest.mark.parametrize(
    ("stated", "name"),
    [
        ({"author": ["imujoco_minari"]}, "apache-2.0"),
        ({"author": ["someone"]}, "unknown"),
        ({"author": ["someone", "imujoco_minari"]}, "unknown"),
        ({"author": ["someone"], "license": "Apache-2.0"}, "apache-2.0"),
    ],
)
def test_others_data_is_not_licensed_by_us(published: Path, tmp_path: Path, stated: Any, name: str) -> None:
    shutil.copytree(published / BASE / "data", tmp_path / "data")
    edit_metadata(tmp_path / "data" / "metadata.json", **stated)
    text = card.dataset_card(tmp_path / "data", REMOTE)
    assert f"license: {name}\n" in text
    assert ("not from its archive" in text) == (stated["author"] == ["imujoco_minari"])


def test_a_card_promises_no_replay_of_a_collection_with_imported_episodes(
    published: Path, tmp_path: Path
) -> None:
    shutil.copytree(published / BASE / "data", tmp_path / "data")
    promise = "seeds and actions replay the whole dataset"
    assert promise in card.dataset_card(tmp_path / "data", REMOTE)
    with h5py.File(tmp_path / "data" / MAIN_FILE, "a") as file:
        file["episode_1"].attrs["replayable"] = False
    assert promise not in card.dataset_card(tmp_path / "data", REMOTE)


def test_a_card_names_the_universal_policy_of_a_folded_expert(published: Path, tmp_path: Path) -> None:
    shutil.copytree(published / BASE / "data", tmp_path / "data")
    told = {"policy_told": {"mass/leggeom": -25.0}, "universal_sha256": "0af1"}
    edit_metadata(tmp_path / "data" / "metadata.json", **told)
    text = card.dataset_card(tmp_path / "data", REMOTE)
    assert "| universal sha256 | `0af1` |" in text
    assert "| policy told | `{'mass/leggeom': -25.0}` |" in text


@pytest.mark.parametrize(
    ("dataset_id", "stated", "command"),
    [
        ("hopper-base-v0", {"policy_deterministic": True}, "publish hopper-base --episodes 2 --seed 0"),
        ("hopper-base-random-v0", {}, "publish hopper-base --tier random --episodes 2 --seed 0"),
        (
            "hopper-base-medium-large-v0",
            {},
            "publish hopper-base --tier medium-large --episodes 2 --seed 0 --stochastic",
        ),
        ("hopper-base-medium-replay-v0", {}, "publish hopper-base --tier medium-replay --seed 0"),
        ("hopper-base-replay-v0", {}, "train hopper-base --record-replay"),
        ("hopper-both-v0", {"combined_datasets": [HOPPER]}, f"combine {HOPPER} --id {LINKED}"),
        (
            "hopper-both-v0",
            {"combined_datasets": [HOPPER], "linked": []},
            f"combine {HOPPER} --id {LINKED} --link",
        ),
        ("hopper-base-mine-v0", {}, ""),
        ("hopper-base-random-v0", {"author": ["someone"]}, ""),
    ],
)
def test_a_card_states_the_command_that_makes_the_dataset(
    dataset_id: str, stated: dict[str, Any], command: str
) -> None:
    made = {"author": ["imujoco_minari"], "total_episodes": 2, "policy_deterministic": False} | stated
    found = card._reproducing_command(made | {"dataset_id": f"imujoco/{dataset_id}"})
    assert found == (f"imujoco {command}" if command else "")


def test_pulling_leaves_alone_what_is_here_and_names_what_is_not_there(store: FolderStore) -> None:
    assert [outcome.downloaded for outcome in remotes.pull(HOPPER, REMOTE)] == [False]
    with pytest.raises(DatasetNotFoundError, match="gcp://bucket lists no imujoco/nothing-v0"):
        remotes.pull("imujoco/nothing-v0", REMOTE)


def test_a_batch_goes_on_past_a_failure_and_names_it(
    store: FolderStore, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["push", "imujoco/nothing-v0", HOPPER, "--remote", REMOTE]) == 2
    output = capsys.readouterr()
    assert f"pushed {HOPPER} to {REMOTE}" in output.out
    assert "error: imujoco/nothing-v0 is not in the Minari root" in output.err
    assert "pushed 1, failed 1" in output.err
    assert run(["pull", HOPPER, "--remote", REMOTE, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["downloaded"] is False


def test_a_dry_run_says_what_a_push_would_upload_and_uploads_nothing(
    store: FolderStore, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["push", LINKED, "--dry-run", "--json"]) == 0
    planned = {each["dataset_id"]: each["bytes"] for each in json.loads(capsys.readouterr().out)}
    assert planned == {name: sum(map(len, files(root, name).values())) for name in (HOPPER, BASE, LINKED)}
    assert run(["push", "imujoco/nothing-v0", HOPPER, "--dry-run"]) == 2
    output = capsys.readouterr()
    assert output.err.startswith("2 datasets: ")
    assert f"would push {HOPPER}: " in output.out
    assert "imujoco/nothing-v0 is not in the Minari root" in output.err
    assert run(["push", HOPPER, "--dry-run", "--remote", "s3://mine"]) == 1
    assert "malformed remote 's3://mine'" in capsys.readouterr().err
    assert store.uploads == []


def test_collections_come_along_if_nothing_else_is_in_them(store: FolderStore) -> None:
    assert remotes.collections_of([HOPPER]) == []
    assert remotes.collections_of([HOPPER, BASE]) == [LINKED]
    filters = ["--robot", "hopper", "--with-base", "--tier", "random"]
    assert run(["push", *filters, "--with-collections", "--remote", REMOTE]) == 0
    assert sorted(store.list_datasets()) == sorted([HOPPER, BASE, LINKED])
    card_of = store.folder / LINKED / stores.CARD
    assert "combined from | 2 datasets" in card_of.read_text()


@pytest.mark.parametrize("address", ["bucket", "s3://bucket", "hf://", "gcp://a/b", "hf://user\n"])
def test_a_malformed_address_is_told(address: str) -> None:
    with pytest.raises(RemoteError, match=r"malformed remote .*valid: hf://<user> or gcp://<bucket>"):
        stores.connect(address)


@pytest.mark.parametrize(
    ("address", "package"), [("hf://u", "huggingface_hub"), ("gcp://b", "google.cloud.exceptions")]
)
def test_a_missing_package_is_told_with_its_remedy(
    address: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("huggingface", "gcp"):
        monkeypatch.delitem(sys.modules, f"imujoco_minari.remotes.{name}", raising=False)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(DependencyError, match=r'pip install "imujoco-minari\[remote\]"'):
        stores.connect(address)


def test_without_a_remote_the_command_says_how_to_name_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["pull", HOPPER]) == 1
    assert "name a remote with --remote, or in MINARI_REMOTE" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("status", "address", "message"),
    [
        (404, "gcp://bucket", "no such bucket; create it first"),
        (404, "hf://user", "no such user"),
        (401, "hf://user", "the token is missing or not accepted"),
        (403, "gcp://bucket", "the token does not allow this"),
        (429, "hf://user", "wait and run the command again"),
        (500, "hf://user", "OSError: server"),
    ],
)
def test_an_error_of_the_remote_is_one_line_about_what_to_do(status: int, address: str, message: str) -> None:
    error = OSError("server\nstack")
    error.code = status  # type: ignore[attr-defined]
    with pytest.raises(RemoteError, match=message) as raised, stores.remote_errors(address):
        raise error
    assert "\n" not in str(raised.value)


def test_a_mistake_of_ours_is_not_told_as_the_remotes() -> None:
    with pytest.raises(TypeError), stores.remote_errors(REMOTE):
        len(3)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("rows", "name"),
    [
        (0, "n<1K"),
        (999, "n<1K"),
        (1000, "1K<n<10K"),
        (99_999, "10K<n<100K"),
        (10**6, "1M<n<10M"),
        (10**9, "n>1B"),
    ],
)
def test_sizes_are_the_hubs(rows: int, name: str) -> None:
    assert card.size_category(rows) == name


def test_a_card_says_what_a_dataset_is(published: Path) -> None:
    text = card.dataset_card(published / HOPPER / "data", "hf://user")
    head = text.split("---\n")[1]
    assert "license: apache-2.0\n" in head
    assert "size_categories:\n- n<1K\n" in head
    assert "task_categories:\n- reinforcement-learning\n- robotics\n" in head
    assert '- "minari"\n' in head
    assert "| mass of leg | 2.78136 | 2.08602 | kg |" in text
    assert "export MINARI_REMOTE=hf://user" in text
    assert f'minari.load_dataset("{HOPPER}", download=True)' in text
    assert "imujoco publish hopper-massdec_25_leggeom --tier random --episodes 2 --seed 0" in text
    assert "zenodo.org/records/7971395" in text
    with h5py.File(published / HOPPER / "data" / MAIN_FILE) as file:
        assert str(file.attrs["content_sha256"]) in text


def test_the_card_of_a_namespace_lists_its_datasets(store: FolderStore) -> None:
    remotes.push(LINKED, REMOTE)
    text = (store.folder / "imujoco" / "README.md").read_text()
    assert [line.split("`")[1] for line in text.splitlines() if line.startswith("| `")] == sorted(
        [HOPPER, BASE, LINKED]
    )


def other_content(seed: int = 7) -> None:
    publish("hopper-base", tier="random", episodes=3, seed=seed, force=True)


def test_pull_force_replaces_only_what_is_named(store: FolderStore, root: Path) -> None:
    remotes.push(LINKED, REMOTE)
    other_content()
    before = files(root, BASE), files(root, LINKED)
    assert run(["pull", LINKED, "--remote", REMOTE, "--force"]) == 1
    assert (files(root, BASE), files(root, LINKED)) == before
    with pytest.raises(
        DatasetError, match=rf"^{BASE} is needed from {REMOTE}, but the dataset here has other"
    ):
        remotes.pull(LINKED, REMOTE, force=True)
    assert run(["pull", LINKED, BASE, "--remote", REMOTE, "--force"]) == 0
    assert files(root, BASE) == files(store.folder, BASE)
    assert not verification.verify(LINKED)


def test_a_source_that_is_here_with_the_same_content_is_used(store: FolderStore, root: Path) -> None:
    remotes.push(LINKED, REMOTE)
    inode = (root / BASE).stat().st_ino
    outcomes = remotes.pull(LINKED, REMOTE, force=True)
    assert [(outcome.dataset_id, outcome.downloaded) for outcome in outcomes] == [
        (HOPPER, False),
        (BASE, False),
        (LINKED, True),
    ]
    assert (root / BASE).stat().st_ino == inode


def test_pull_force_replaces_nothing_before_all_checks_have_passed(store: FolderStore, root: Path) -> None:
    remotes.push(LINKED, REMOTE)
    edit_metadata(store.folder / LINKED / stores.METADATA_PATH, tier="expert")
    other_content()
    before = files(root, BASE), files(root, LINKED)
    (outcome,) = pulling.pull_all([LINKED], REMOTE, force=True)
    assert outcome.error
    # BASE is named here: it is replaced on its own account, after the collection has failed.
    failed, pulled = pulling.pull_all([LINKED, BASE], REMOTE, force=True)
    assert failed.dataset_id == LINKED
    assert "its check found" in failed.error
    assert (pulled.dataset_id, pulled.downloaded) == (BASE, True)
    assert (files(root, BASE), files(root, LINKED)) == (files(store.folder, BASE), before[1])


def test_a_collection_that_names_itself_is_pulled(store: FolderStore, elsewhere: Callable[[], Path]) -> None:
    name = "imujoco/hopper-itself-v0"
    combine_datasets([HOPPER], name)
    combine_datasets([name, BASE], name, force=True)
    assert [outcome.dataset_id for outcome in remotes.push(name, REMOTE)] == [BASE, name]
    elsewhere()
    assert [outcome.dataset_id for outcome in remotes.pull(name, REMOTE)] == [BASE, name]


def test_datasets_that_are_made_of_each_other_are_pushed(store: FolderStore) -> None:
    first, second = "imujoco/hopper-first-v0", "imujoco/hopper-second-v0"
    combine_datasets([HOPPER], first)
    combine_datasets([first, BASE], second, link=True)
    combine_datasets([second], first, force=True)
    assert [outcome.dataset_id for outcome in remotes.push(first, REMOTE)] == [BASE, second, first]


def test_push_force_replaces_only_what_is_named(store: FolderStore) -> None:
    remotes.push(LINKED, REMOTE)
    before = files(store.folder, BASE)
    other_content()
    combine_datasets([HOPPER, BASE], LINKED, link=True, force=True)
    with pytest.raises(
        DatasetExistsError, match=rf"another {BASE}.*`imujoco push {BASE} --force` replaces it"
    ):
        remotes.push(LINKED, REMOTE, force=True)
    assert files(store.folder, BASE) == before
    assert all(not outcome.error for outcome in remotes.push_all([BASE, LINKED], REMOTE, force=True))
    assert store.holds(BASE)


def test_a_killed_pull_force_loses_nothing_where_folders_cannot_be_swapped(
    store: FolderStore, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    remotes.push(BASE, REMOTE)
    other_content()
    # Dies between the two renames; a process that is killed tidies nothing.
    monkeypatch.setattr(transactions, "exchange", lambda source, target: False)
    rename = Path.rename

    def killed(path: Path, target: Path) -> Path:
        if Path(target) == root / BASE and not Path(target).exists():
            raise KeyboardInterrupt
        return rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", killed)
        patch.setattr(transactions, "_discard", lambda folder, lock: os.close(lock))
        with pytest.raises(KeyboardInterrupt):
            remotes.pull(BASE, REMOTE, force=True)
    assert not minari_root.exists(BASE)
    transactions.tidy()
    assert minari_root.exists(BASE)
    assert verification.verify(BASE) == []
