"""Hyperparameters come from the file, the robot's page and the user, in this order, and are checked."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from imujoco_minari.cli.app import run
from imujoco_minari.errors import CatalogueError
from imujoco_minari.training import sweep
from imujoco_minari.training.hyperparameters import SCRATCH, WARM, hyperparameter_changes, hyperparameters
from imujoco_minari.training.sweep import Trained
from imujoco_minari.training.task import Plan
from imujoco_minari.variants import ROBOTS, Variant, specification


@pytest.mark.parametrize("robot", ROBOTS)
def test_hyperparameters_are_layered_and_checked(robot: str) -> None:
    scratch, warm = hyperparameters(robot, SCRATCH), hyperparameters(robot, WARM)
    assert warm.max_steps < scratch.max_steps
    assert hyperparameters(robot, WARM, max_steps=7).max_steps == 7
    with pytest.raises(CatalogueError, match="unknown hyperparameter 'gama'"):
        hyperparameters(robot, WARM, gama=0.9)


def test_a_text_sets_a_value_of_the_right_type() -> None:
    changes = hyperparameter_changes(
        ["batch_size=256", "learning_rate=3e-4", "exploration_steps=0", "batch_size=64"]
    )
    assert changes == {"batch_size": 64, "learning_rate": 3e-4, "exploration_steps": 0}
    assert [type(value) for value in changes.values()] == [int, float, int]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("batch_size", r"cannot set 'batch_size': write NAME=VALUE; names: anchor, average, batch_size, "),
        ("batch_sise=3", r"cannot set 'batch_sise=3' \(did you mean 'batch_size'\?\): write NAME=VALUE"),
        ("algorithm=TQC", "cannot set 'algorithm=TQC'"),
        ("batch_size=", "batch_size is a whole number above 0"),
        ("batch_size=0.5", "batch_size is a whole number above 0"),
        ("evaluate_every=0", "evaluate_every is a whole number above 0"),
        ("gamma=nan", "gamma is a number above 0"),
        ("learning_rate=1e999", "learning_rate is a number above 0"),
        ("exploration_steps=-1", "exploration_steps is a whole number of at least 0"),
    ],
)
def test_a_bad_text_is_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(CatalogueError, match=message):
        hyperparameter_changes([text])


def test_the_command_line_passes_the_changes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plans: list[Plan] = []

    def train(variant: Variant, plan: Plan, *callbacks: object) -> Trained:
        plans.append(plan)
        return Trained(variant, {"variant": str(variant)}, error="not tried")

    monkeypatch.setattr(sweep, "train", train)
    monkeypatch.setattr("os.nice", lambda by: 0)
    given = ["--set", "gamma=0.98", "--set", "max_steps=7", "--max-steps", "9", "--state", str(tmp_path)]
    assert run(["train", "hopper-massinc_37_torsogeom", *given, "--json"]) == 1
    assert plans[0].changes == {"gamma": 0.98, "max_steps": 9}
    assert json.loads(capsys.readouterr().out)[0]["error"] == "not tried"
    assert run(["train", "hopper-base", "--set", "gama=1"]) == 2
    assert "did you mean 'gamma'" in capsys.readouterr().err
    assert run(["train", "--universal"]) == 2
    assert "give --robot ROBOT and no variants" in capsys.readouterr().err


def test_a_page_with_a_value_that_a_hyperparameter_cannot_have_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    page = replace(specification("hopper"), training={WARM: {"max_steps": 7.5}})
    monkeypatch.setattr("imujoco_minari.training.hyperparameters.specification", lambda robot: page)
    with pytest.raises(
        CatalogueError, match=r"page of hopper, \[training.warm\]: max_steps is a whole number"
    ):
        hyperparameters("hopper", WARM)
