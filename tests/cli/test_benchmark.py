"""``imujoco benchmark``: a cell by its commands, from the computation to the page."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from actor_datasets import publish_actors

from imujoco_minari.benchmark import reproduction
from imujoco_minari.benchmark.protocol import holding_out
from imujoco_minari.cli.app import run
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.variants import ROBOTS, held_out

CELL = ["-m", "random", "--held-out", "hopper-frictiondec_50_feet", "--seeds", "1"]


def test_a_cell_becomes_a_line_a_table_and_a_page(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, root: Path, tmp_path: Path
) -> None:
    # The dataset has eight episodes by random weights, which the command refuses: see below.
    monkeypatch.setattr("imujoco_minari.cli.benchmark._publish", lambda *_, **__: None)
    publish_actors(["imujoco/hopper-frictiondec_50_feet-v0"], root)
    results, page = str(tmp_path / "results"), str(tmp_path / "page")
    assert run(["benchmark", "few-shot", *CELL, "--output", results, "--json"]) == 0
    computed = json.loads(capsys.readouterr().out)
    assert {score["method"] for score in computed} == {"random"}
    assert run(["benchmark", "table", results, "--output", str(tmp_path / "scores.csv"), "--json"]) == 0
    table = capsys.readouterr()
    assert json.loads(table.out) == {"scores": computed, "comparison": []}
    assert "changed" not in table.err
    assert len((tmp_path / "scores.csv").read_text("utf-8").splitlines()) == 1 + len(computed)
    assert run(["benchmark", "page", results, "--output", page]) == 0
    assert "| random | 0 | 0.00 |" in (tmp_path / "page" / "results.md").read_text("utf-8")
    publish("hopper-frictiondec_50_feet", tier="expert", episodes=2, force=True)
    capsys.readouterr()
    assert run(["benchmark", "table", results]) == 0
    message = capsys.readouterr().err
    assert "imujoco/hopper-frictiondec_50_feet-v0 is not the data of these lines" in message
    assert "(lines: 1)" in message


def test_a_dataset_of_another_recipe_is_refused(
    capsys: pytest.CaptureFixture[str], root: Path, tmp_path: Path
) -> None:
    publish_actors(["imujoco/hopper-frictiondec_50_feet-v0"], root)
    assert run(["benchmark", "few-shot", *CELL, "--output", str(tmp_path / "results")]) == 1
    message = capsys.readouterr().err
    assert "it has 8 episodes, policy " in message
    assert "you asked for 100 episodes, policy " in message
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize("command", [["few-shot", "-m", "scratch"], ["offline"], ["reproduce"]])
def test_a_missing_extra_is_named_before_anything_is_made(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, root: Path, command: list[str]
) -> None:
    monkeypatch.setitem(sys.modules, "optax", None)
    assert run(["benchmark", *command]) == 1
    assert 'needs optax, which is not installed: run `pip install "imujoco-minari[train]"`' in (
        capsys.readouterr().err
    )
    assert not list(root.rglob("*.hdf5"))


def test_the_table_shows_the_published_comparison(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    errors = {str(shots): {str(steps): 0.3 for steps in reproduction.STEPS} for shots in reproduction.SHOTS}
    line = {"protocol": reproduction.NAME, "method": "maml", "seed": 0, "settings": {}, "results": errors}
    line |= {"train_sha256": "", "data_sha256": "", "versions": {}}
    (tmp_path / reproduction.FILE).write_text(json.dumps(line) + "\n", "utf-8")
    assert run(["benchmark", "table", str(tmp_path), "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    shown = next(row for row in table["comparison"] if (row["windows"], row["steps"]) == (25, 5))
    assert (table["scores"], shown["error"], shown["published"]) == ([], 0.3, 0.38)
    assert run(["benchmark", "table", str(tmp_path)]) == 0
    output = capsys.readouterr()
    assert output.out.split("\n")[0] == "Errors of the actions in the published comparison"
    assert "the settings of maml have changed (lines: 1)" in output.err


def test_a_dry_run_computes_nothing(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run(["benchmark", "few-shot", "--dry-run", "--output", str(tmp_path / "results")]) == 0
    # 31 variants in random splits and 70 in extremes; six methods with budgets, and four comparisons.
    cells = 5 * (31 * (6 * 5 + 4) + 70 * (6 * 2 + 4))
    assert f"{cells} cells" in capsys.readouterr().err
    assert run(["benchmark", "offline", "--dry-run"]) == 0
    assert "180 cells" in capsys.readouterr().err
    assert run(["benchmark", "offline", "--dry-run", "--jobs", "2", "--json"]) == 0
    planned = json.loads(capsys.readouterr().out)
    assert planned["cells"] == 180
    assert planned["publish"][:2] == [
        "imujoco/hopper-base-medium-v0",
        "imujoco/hopper-base-medium-replay-v0",
    ]
    assert run(["benchmark", "few-shot", *CELL, "--dry-run"]) == 0
    assert "to publish first: 1 dataset: about" in capsys.readouterr().err
    assert not (tmp_path / "results").exists()


def test_each_held_out_variant_is_in_the_first_split_that_has_it(capsys: pytest.CaptureFixture[str]) -> None:
    variants = ["hopper-frictiondec_50_feet", "walker2d-frictiondec_50_feet", "hopper-massinc_50_torsogeom"]
    options = [word for variant in variants for word in ("--held-out", variant)]
    splits = [held_out(f"{robot}-{kind}-v1") for robot in ROBOTS for kind in ("extremes", "random")]
    found = [(split.name, split.test) for split in holding_out(variants, splits)]
    assert found == [
        ("hopper-extremes-v1", ("hopper-frictiondec_50_feet",)),
        ("hopper-random-v1", ("hopper-massinc_50_torsogeom",)),
        ("walker2d-extremes-v1", ("walker2d-frictiondec_50_feet",)),
    ]
    few_shot = ["benchmark", "few-shot", "-m", "random", "--seeds", "1", "--dry-run"]
    assert run([*few_shot, *options]) == 0
    assert capsys.readouterr().err.startswith("3 cells")
    assert run([*few_shot, *options, "--held-out", "hopper-base"]) == 2
    assert "hopper-base is held out in none of hopper-extremes-v1, " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["few-shot", "-m", "best"], 2, "no method 'best'"),
        (["few-shot", "--budget", "5x"], 2, "no budget '5x'; valid: <windows>x<steps>"),
        (
            ["few-shot", "--held-out", "hopper-frictiondec_50_fet"],
            2,
            "walker2d-random-v1 (did you mean 'hopper-frictiondec_50_feet'?)",
        ),
        (["few-shot", "-m", "scratch", "--setting", "speed=2"], 2, "no setting 'speed=2'; valid: rate"),
        (["few-shot", "-m", "scratch", "--setting", "rate=fast"], 1, "'rate=fast' is not a finite number"),
        (["few-shot", "-m", "scratch", "--setting", "rate=nan"], 1, "'rate=nan' is not a finite number"),
        (["few-shot", "-m", "math:pi"], 2, "no method 'math:pi': pi is not a class"),
        (["offline", "--base", "ant"], 2, "no robot 'ant' here; valid: hopper"),
        (["table", "nowhere"], 1, "nowhere has no results"),
    ],
)
def test_a_mistake_gets_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, message: str
) -> None:
    assert run(["benchmark", *arguments]) == code
    assert message in capsys.readouterr().err


def test_settings_are_chosen_on_training_variants(capsys: pytest.CaptureFixture[str]) -> None:
    split = ["--split", "hopper-random-v1", "--validation", "--dry-run"]
    assert (
        run(["benchmark", "few-shot", "-m", "scratch", "--seeds", "1", "--setting", "rate=0.01", *split]) == 0
    )
    # 30 training variants, of which every fifth is held out, and 5 budgets.
    assert "30 cells" in capsys.readouterr().err
