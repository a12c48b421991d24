"""``imujoco delete``: asks, refuses what is not one dataset, and spares what a linked collection needs."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import minari
import pytest

from imujoco_minari.cli.app import run
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.publishing.removal import delete, linked_collections
from imujoco_minari.storage import minari_root, transactions

BASE, LEG, FEET = (
    f"imujoco/hopper-{name}-random-v0" for name in ("base", "massdec_25_leggeom", "frictiondec_50_feet")
)
LINKED, COPIED = "imujoco/hopper-linked-v0", "imujoco/hopper-copied-v0"


class Terminal(io.StringIO):
    """Standard input that is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def collections(small_datasets: list[str]) -> None:
    """A linked collection and a copied one of two of the datasets."""
    combine_datasets([BASE, LEG], LINKED, link=True)
    combine_datasets([BASE, LEG], COPIED)


def test_filters_and_tiers_choose(small_datasets: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["delete", "--robot", "hopper", "--tier", "random", "--yes"]) == 0
    assert set(minari.list_local_datasets()) == {BASE}
    output = capsys.readouterr()
    assert output.out.count("deleted imujoco/hopper-") == 2
    assert output.err == "deleted 2, failed 0\n"
    assert run(["delete", "--robot", "hopper", "--tier", "random", "--yes"]) == 2
    assert "no random dataset of --robot hopper is in the Minari root" in capsys.readouterr().err


@pytest.mark.parametrize(("answer", "code", "left"), [("y\n", 0, 2), ("n\n", 1, 3), ("", 1, 3)])
def test_it_asks_first(
    answer: str,
    code: int,
    left: int,
    small_datasets: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal(answer))
    assert run(["delete", LEG]) == code
    assert len(minari.list_local_datasets()) == left
    output = capsys.readouterr()
    assert f"  {LEG}\n" in output.err
    assert "Delete 1 dataset from " in output.err
    assert ("deleted" in output.out) == (code == 0)


def test_a_script_must_say_yes(small_datasets: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["delete", LEG, "--json"]) == 2
    assert "--yes" in json.loads(capsys.readouterr().out)["error"]
    assert len(minari.list_local_datasets()) == 3


def test_the_dataset_of_a_linked_collection_is_kept(
    collections: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert linked_collections() == {BASE: {LINKED}, LEG: {LINKED}}
    assert run(["delete", BASE, FEET, "--yes"]) == 1
    assert f"{BASE} was not deleted: {LINKED} links to its episodes" in capsys.readouterr().err
    assert set(minari.list_local_datasets()) == {BASE, LEG, LINKED, COPIED}
    assert run(["delete", BASE, "--yes", "--force"]) == 0
    assert set(minari.list_local_datasets()) == {LEG, LINKED, COPIED}


def test_a_collection_goes_before_its_datasets(collections: None) -> None:
    outcomes = list(delete([BASE, LEG, LINKED]))
    assert [outcome.dataset_id for outcome in outcomes] == [LINKED, BASE, LEG]
    assert not any(outcome.error for outcome in outcomes)
    assert all(outcome.bytes > 1000 for outcome in outcomes)
    assert set(minari.list_local_datasets()) == {FEET, COPIED}


def test_a_collection_that_stays_keeps_its_datasets(collections: None, root: Path) -> None:
    (root / LINKED / "notes.txt").write_text("mine")
    outcomes = {outcome.dataset_id: outcome.error for outcome in delete([LINKED, BASE])}
    assert f"{root / LINKED} holds other files too: notes.txt" in outcomes[LINKED]
    assert "links to its episodes" in outcomes[BASE]
    assert (root / BASE / "data" / "main_data.hdf5").is_file()


def test_nothing_but_one_dataset_is_deleted(small_datasets: list[str], root: Path, tmp_path: Path) -> None:
    (root / "imujoco" / "empty-v0" / "data").mkdir(parents=True)
    (root / "imujoco" / "file-v0").write_text("a file")
    for name in ("imujoco/empty-v0", "imujoco/file-v0"):
        (outcome,) = delete([name])
        assert "there is no dataset at" in outcome.error
        assert (root / name).exists()
    for name in ("imujoco", "..", "imujoco/../imujoco-v0", str(tmp_path)):
        (outcome,) = delete([name])
        assert outcome.missing
        assert "malformed dataset id" in outcome.error
    (outcome,) = delete(["imujoco/nothing-v0"])
    assert (outcome.missing, outcome.error.count("is not in the Minari root")) == (True, 1)


def test_a_link_to_a_dataset_elsewhere_goes_and_the_dataset_stays(
    small_datasets: list[str], root: Path, tmp_path: Path
) -> None:
    (root / LEG).rename(tmp_path / "elsewhere")
    (root / LEG).symlink_to(tmp_path / "elsewhere")
    (outcome,) = delete([LEG])
    assert outcome.error == ""
    assert not minari_root.exists(LEG)
    assert (tmp_path / "elsewhere" / "data" / "main_data.hdf5").is_file()
    assert not (root / transactions.STAGING).exists()
