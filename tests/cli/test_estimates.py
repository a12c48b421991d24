"""What long work costs is stated before it, and ``--dry-run`` states it and does nothing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import imujoco_minari.cli  # noqa: F401
from imujoco_minari.cli import estimates
from imujoco_minari.cli.app import run
from imujoco_minari.cli.estimates import (
    Planned,
    cost,
    plan,
    publishing_line,
    time_text,
    training_line,
)
from imujoco_minari.cli.printing import counted
from imujoco_minari.publishing.publisher import publish_recipe
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.variants import Variant, bases, catalogue

LEG = Variant.parse("hopper-massdec_25_leggeom")


@pytest.mark.parametrize(
    ("recipe", "tolerance"), [(Recipe(LEG, episodes=2), 0.06), (Recipe(LEG, "random", 40), 0.4)]
)
def test_the_size_is_that_of_the_dataset(recipe: Recipe, tolerance: float) -> None:
    planned = plan(recipe)
    assert planned.action == "publish"
    published = publish_recipe(recipe)
    assert published.path is not None
    size = sum(file.stat().st_size for file in published.path.rglob("*") if file.is_file())
    assert planned.bytes == pytest.approx(size, rel=tolerance)
    # Machines differ; the order of magnitude must not.
    assert planned.seconds / 10 < published.seconds < planned.seconds * 100
    assert plan(recipe).action == "leave alone"
    assert plan(recipe, force=True).action == "replace"


def test_a_policy_file_has_no_record_of_its_lengths(tmp_path: Path) -> None:
    random = plan(Recipe(LEG, "random", 10))
    assert random.bytes < plan(Recipe(LEG, episodes=10)).bytes / 10
    missing = plan(Recipe(LEG, "random", 10, policy=tmp_path / "none.zip"))
    assert missing.missing
    assert "no policy file at" in missing.error


def test_a_dry_run_prints_the_plan_and_does_nothing(
    root: Path, small_datasets: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(root.rglob("*"))
    arguments = ["publish", "--robot", "hopper", "--category", "friction", "--with-base", "--dry-run"]
    assert run([*arguments, "--tier", "random", "--jobs", "2", "--episodes", "4"]) == 1
    output = capsys.readouterr()
    assert output.out.count("would publish imujoco/hopper-friction") == 2
    assert output.out.count("would leave alone imujoco/hopper-") == 1
    assert "hopper-base-random-v0 is already published, but differs: it has 8 episodes" in output.err
    assert output.err.startswith("4 datasets, 2 of them to publish: about ")
    assert "with 2 processes" in output.err
    assert run([*arguments, "--tier", "no-such-tier", "--json"]) == 2
    assert {row["missing"] for row in json.loads(capsys.readouterr().out)} == {True}
    assert sorted(root.rglob("*")) == before


def test_the_whole_catalogue_in_a_line() -> None:
    planned = [plan(Recipe(variant)) for variant in catalogue()]
    line = publishing_line(planned, 2)
    assert line.startswith("154 datasets: about 2.")
    assert " GB and " in line
    assert line.endswith(" minutes with 2 processes on as many cores")
    assert publishing_line([*planned, Planned("x", "leave alone")], 1).startswith(
        "155 datasets, 154 of them to"
    )


@pytest.mark.parametrize("count", ["x", None, -1, 1.5, 10**400])
def test_a_dataset_that_states_no_count_is_named(
    count: object, root: Path, small_datasets: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    one, two = small_datasets[:2]
    path = root / two / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"total_steps": count}))
    assert run(["export", one, two, "-f", "npz", "--dry-run"]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"error: {two}: total_steps in metadata.json is ")
    assert error.endswith(f"which is no count; see `imujoco verify {two}`\n")


@pytest.mark.usefixtures("unshipped")
def test_training_counts_what_has_no_expert() -> None:
    assert training_line([LEG], None, 1, improve=False) == "1 expert: about 160.0 kB and 11 minutes"
    assert training_line([*bases(), *catalogue()], None, 2, improve=False) == (
        "157 experts: about 36.6 MB and 14.7 hours with 2 processes on as many cores"
    )


def test_training_leaves_out_what_has_an_expert(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["train", "--robot", "hopper", "-c", "friction"]) == 0
    output = capsys.readouterr()
    assert output.err.startswith("3 experts, 0 of them to train: about 0 bytes and 0 seconds\n")
    assert output.out.count("left alone") == 3
    assert training_line([LEG], None, 1, improve=True) == "1 expert: about 160.0 kB and 11 minutes"


def test_the_gallery_in_a_line() -> None:
    assert estimates.gallery_line(157).startswith("157 variants and bases: about 7.1 MB and 10 minutes")


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (time_text(1), "1 second"),
        (time_text(89), "89 seconds"),
        (time_text(95), "2 minutes"),
        (time_text(7300), "2.0 hours"),
        (cost(1e6, 60, jobs=2), "about 1.0 MB and 30 seconds with 2 processes on as many cores"),
        (counted(1, "policy"), "1 policy"),
        (counted(0, "policy"), "0 policies"),
        (counted(2, "dataset"), "2 datasets"),
    ],
)
def test_amounts_are_words(text: str, shown: str) -> None:
    assert text == shown
