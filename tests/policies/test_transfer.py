"""Policies on variants they were not made for: every cell once, kept, gone on with, as CSV and as picture."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from random_actors import random_actor
from safetensors.numpy import save_file

from imujoco_minari.cli.app import run
from imujoco_minari.errors import JobError, PolicyError, PolicyNotFoundError, StorageError, TransferError
from imujoco_minari.policies import Actor, Policy, RandomPolicy
from imujoco_minari.policies import transfer as module
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.experts import is_folded
from imujoco_minari.policies.transfer import (
    COLUMNS,
    Transfer,
    columns,
    evaluate_transfer,
    expert_policies,
    write_csv,
)
from imujoco_minari.variants import Variant

VARIANTS = tuple(
    Variant.parse(f"hopper-{name}") for name in ("base", "massdec_50_footgeom", "lengthinc_50_leggeom")
)


def actor(units: int, *sizes: int) -> Actor:
    """An actor that differs from those with other numbers of hidden units."""
    return random_actor(*sizes, widths=(units,))


@pytest.fixture
def policies() -> dict[str, Policy]:
    return {"hopper-base": actor(4), "mine": actor(1), "random": RandomPolicy(3)}


@pytest.fixture
def evaluated(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """The cells that are really evaluated."""
    cells: list[tuple[str, str]] = []
    inner = module._evaluate_cell

    def count(cell: Any) -> Any:
        cells.append((cell.policy_name, str(cell.variant)))
        return inner(cell)

    monkeypatch.setattr(module, "_evaluate_cell", count)
    return cells


def evaluations(transfer: Transfer) -> dict[tuple[str, Variant], Any]:
    return {cell: (result.asdict(), result.variants) for cell, result in transfer.cells.items()}


def test_every_policy_is_evaluated_on_every_variant(tmp_path: Path, policies: dict[str, Policy]) -> None:
    result = evaluate_transfer(policies, VARIANTS, tmp_path / "state.json", episodes=2, seed=4)
    assert result.policies == ("hopper-base", "mine", "random")
    assert len(result.cells) == 9
    expected = evaluate(VARIANTS[2], policies["mine"], episodes=2, seed=4)
    assert result.cells["mine", VARIANTS[2]].asdict() == expected.asdict()
    assert result.returns()[1][2] == expected.return_mean


def test_a_run_that_was_broken_off_goes_on_and_a_finished_one_evaluates_nothing(
    tmp_path: Path, policies: dict[str, Policy], evaluated: list[tuple[str, str]]
) -> None:
    def break_off() -> None:
        if len(evaluated) == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate_transfer(policies, VARIANTS, tmp_path / "state.json", episodes=1, on_cell=break_off)
    assert len(evaluated) == 4
    first = evaluate_transfer(policies, VARIANTS, tmp_path / "state.json", episodes=1)
    assert len(evaluated) == len(set(evaluated)) == 9
    second = evaluate_transfer(policies, VARIANTS, tmp_path / "state.json", episodes=1)
    assert len(evaluated) == 9
    assert evaluations(second) == evaluations(first)
    assert [path.name for path in tmp_path.iterdir()] == ["state.json"]


@pytest.mark.parametrize(("change", "anew"), [("policy", 3), ("seed", 9), ("episodes", 9), ("stochastic", 3)])
def test_what_has_changed_is_evaluated_anew(
    change: str, anew: int, tmp_path: Path, policies: dict[str, Policy], evaluated: list[tuple[str, str]]
) -> None:
    evaluate_transfer(policies, VARIANTS, tmp_path / "state.json", episodes=1)
    evaluated.clear()
    options = {"episodes": 2 if change == "episodes" else 1, "seed": int(change == "seed")}
    if change == "policy":
        policies["mine"] = actor(2)
    if change == "stochastic":
        policies["mine"] = Actor(actor(1).weights, deterministic=False)
    evaluate_transfer(policies, VARIANTS, tmp_path / "state.json", **options)
    assert len(evaluated) == anew


def test_it_does_not_matter_in_which_order_the_results_come(
    tmp_path: Path, policies: dict[str, Policy], monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = evaluate_transfer(policies, VARIANTS[:2], tmp_path / "a.json", episodes=1)
    asked: list[int] = []

    def backwards(function: Any, cells: list[Any], *, jobs: int) -> Any:
        asked.append(jobs)
        return ((number, function(cells[number])) for number in reversed(range(len(cells))))

    monkeypatch.setattr(module, "run_jobs", backwards)
    together = evaluate_transfer(policies, VARIANTS[:2], tmp_path / "b.json", episodes=1, jobs=2)
    assert evaluations(together) == evaluations(alone)
    assert asked == [2]


def test_a_cell_that_is_lost_with_its_process_is_named_and_the_others_are_kept(
    tmp_path: Path, policies: dict[str, Policy], monkeypatch: pytest.MonkeyPatch
) -> None:
    def losing(function: Any, cells: list[Any], *, jobs: int) -> Any:
        yield 0, function(cells[0])
        yield 1, JobError("lost with its worker")

    monkeypatch.setattr(module, "run_jobs", losing)
    with pytest.raises(TransferError, match="hopper-base on hopper-massdec_50_footgeom: lost"):
        evaluate_transfer(policies, VARIANTS, tmp_path / "state.json", episodes=1, jobs=2)
    kept = json.loads((tmp_path / "state.json").read_text())["cells"]
    assert list(kept["hopper-base"]) == ["hopper-base"]


def test_a_policy_of_another_robot_is_refused_before_the_work(
    tmp_path: Path, evaluated: list[tuple[str, str]]
) -> None:
    with pytest.raises(PolicyError, match="it fits halfcheetah and walker2d"):
        evaluate_transfer({"a": actor(4), "b": actor(2, 17, 6)}, VARIANTS, tmp_path / "state.json")
    assert evaluated == []


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": 99, "cells": {}}'])
def test_a_file_that_is_no_state_is_left_alone(
    text: str, tmp_path: Path, policies: dict[str, Policy]
) -> None:
    state = tmp_path / "state.json"
    state.write_text(text)
    with pytest.raises(TransferError, match=r"state\.json is not a state file of a transfer"):
        evaluate_transfer(policies, VARIANTS, state)
    assert state.read_text() == text


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, policies: dict[str, Policy]) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot write"):
        evaluate_transfer(policies, VARIANTS, tmp_path / "file" / "state.json", episodes=1)


def test_the_numbers_are_written_as_csv(tmp_path: Path, policies: dict[str, Policy]) -> None:
    result = evaluate_transfer(policies, VARIANTS, tmp_path / "state.json", episodes=2)
    write_csv(result, tmp_path / "numbers.csv")
    with (tmp_path / "numbers.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == 9
    for row in rows:
        cell = result.cells[row["policy"], Variant.parse(row["variant"])]
        assert float(row["return_mean"]) == cell.return_mean
        assert float(row["length_mean"]) == cell.length_mean
        assert row["category"] == Variant.parse(row["variant"]).category


def test_the_columns_are_the_base_and_the_catalogue() -> None:
    assert len(columns("hopper")) == 38
    assert str(columns("walker2d", "friction")[0]) == "walker2d-base"
    assert len(columns("walker2d", "friction")) == 4


def test_without_experts_it_is_said_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "expert_record", lambda variant: {})
    with pytest.raises(
        PolicyNotFoundError, match=r"no expert policy of hopper for mass: train .* --policy FILE"
    ):
        expert_policies("hopper", "mass")


def test_every_variant_of_a_robot_has_its_expert_in_the_matrix_be_it_own_or_folded() -> None:
    assert list(expert_policies("hopper")) == [str(variant) for variant in columns("hopper")]
    folded = expert_policies("hopper", "joint")["hopper-jointdec_25_legjoint"]
    assert isinstance(folded, Actor)
    assert is_folded(folded.record)


def test_the_command_writes_numbers_and_pictures_and_goes_on(
    tmp_path: Path, evaluated: list[tuple[str, str]], capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    save_file(dict(actor(5).weights), tmp_path / "mine.safetensors")
    folder = tmp_path / "out"
    arguments = ["transfer", "--robot", "hopper", "-c", "friction", "-n", "1", "--output", str(folder)]
    arguments += ["--policy", str(tmp_path / "mine.safetensors")]
    assert run(arguments) == 0
    assert "1 policy on 3 variants and 1 base, 1 episode each" in capsys.readouterr().out
    assert sorted(path.name for path in folder.iterdir()) == [
        "transfer.csv",
        "transfer.json",
        "transfer.png",
        "transfer.svg",
    ]
    assert len(evaluated) == 4
    assert run([*arguments, "--json"]) == 0
    assert len(evaluated) == 4
    told = json.loads(capsys.readouterr().out)
    assert told["policies"] == ["mine"]
    assert np.shape(told["returns"]) == (1, 4)


def test_the_command_names_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["transfer"]) == 2
    assert "--robot" in capsys.readouterr().err
    assert run(["transfer", "--robot", "hoper"]) == 2
    assert "did you mean" in capsys.readouterr().err
    assert run(["transfer", "--robot", "hopper", "--policy", str(tmp_path / "none.zip")]) == 2
    assert "no policy file at" in capsys.readouterr().err
