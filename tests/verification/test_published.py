"""`verify --published`: a dataset is compared with the digest that this version lists."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from imujoco_minari.cli.app import run
from imujoco_minari.errors import DatasetError, NotFoundError
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.storage.metadata import complete_metadata
from imujoco_minari.variants import bases, catalogue
from imujoco_minari.verification import published, verify

BASE = "imujoco/hopper-base-v0"


@pytest.fixture
def listed(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A list of one dataset of one episode, which the Minari root holds."""
    file = tmp_path / "published.json"
    file.write_text('{"made_with": {}, "datasets": {}}')
    monkeypatch.setattr(published, "FILE", file)
    published._content.cache_clear()
    publish("hopper-base", episodes=1)
    file.write_text(published.listing([BASE]))
    published._content.cache_clear()
    yield file
    published._content.cache_clear()


def test_the_dataset_that_this_version_makes(listed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["verify", BASE, "--published", "--no-replay"]) == 0
    assert capsys.readouterr().out == f"{BASE}: sound, as published\n"


def test_another_recipe_is_a_finding(listed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    publish("hopper-base", episodes=1, seed=3, force=True)
    assert verify(BASE, replay=False) == []
    assert [str(each) for each in verify(BASE, replay=False, published=True)] == [
        "metadata.json/seed: is 3, not 0, as published"
    ]
    assert run(["verify", BASE, "--published", "--no-replay"]) == 1


def test_other_content_of_the_same_recipe_is_a_finding(listed: Path) -> None:
    content = json.loads(listed.read_text())
    content["datasets"][BASE]["content_sha256"] = "0" * 64
    content["made_with"]["machine"] = "another"
    listed.write_text(json.dumps(content))
    published._content.cache_clear()
    (finding,) = verify(BASE, replay=False, published=True)
    assert finding.where == "metadata.json/content_sha256"
    assert finding.what.endswith("as published with other machine")


def test_a_dataset_that_is_not_listed(listed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = publish("hopper-base", tier="random", episodes=1).dataset_id
    assert run(["verify", name, "--published"]) == 2
    assert f"this version lists no digest of {name}; listed: {BASE}" in capsys.readouterr().err


def test_a_digest_of_an_expert_that_is_no_longer_shipped_does_not_count(listed: Path) -> None:
    content = json.loads(listed.read_text())
    content["datasets"][BASE]["policy_sha256"] = "0" * 64
    listed.write_text(json.dumps(content))
    published._content.cache_clear()
    with pytest.raises(NotFoundError, match="lists no digest"):
        verify(BASE, published=True)
    # A new list drops it.
    content["datasets"]["imujoco/walker2d-base-v0"] = content["datasets"][BASE]
    listed.write_text(json.dumps(content))
    published._content.cache_clear()
    assert list(json.loads(published.listing([BASE]))["datasets"]) == [BASE]


def test_only_datasets_of_shipped_experts_are_listed(listed: Path, root: Path) -> None:
    complete_metadata(root / BASE / "data", {"policy_sha256": "0" * 64})
    with pytest.raises(DatasetError, match="is not a dataset of the shipped expert"):
        published.listing([BASE])


def test_the_list_of_this_version() -> None:
    datasets = json.loads(Path(published.__file__).with_name("published.json").read_text())["datasets"]
    known = {variant.dataset_id() for variant in (*bases(), *catalogue())}
    assert datasets
    assert datasets.keys() <= known
    for entry in datasets.values():
        assert entry.keys() == {"total_episodes", "seed", "policy_sha256", "content_sha256"}
        assert re.fullmatch(r"[0-9a-f]{64}", entry["content_sha256"])
