"""One tiny cell of each method; cells that depend on nothing but their line; runs that continue."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imujoco_minari.benchmark.checks import changes
from imujoco_minari.benchmark.cloning import BaseExpert, MultiVariant, Scratch
from imujoco_minari.benchmark.few_shot import FILE, FewShotGrid, run_few_shot
from imujoco_minari.benchmark.history import History
from imujoco_minari.benchmark.lines import Line, append_lines, identity, read_lines, run_lines
from imujoco_minari.benchmark.meta import Maml, SetEncoder
from imujoco_minari.benchmark.methods import METHODS, NewMethod, find_method, settings_of, with_settings
from imujoco_minari.benchmark.protocol import Budget
from imujoco_minari.errors import BenchmarkError, StorageError
from imujoco_minari.loading import Arrays
from imujoco_minari.policies import random_policy
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.variants import HeldOut, held_out

SPLIT = HeldOut(
    "mine", train=["hopper-base", "hopper-massdec_25_leggeom"], test=["hopper-frictiondec_50_feet"]
)
STEPS = (0, 1, 3)
TINY: Mapping[str, NewMethod] = {
    **METHODS,
    "scratch": partial(Scratch, steps=STEPS[1:]),
    "base-expert": partial(BaseExpert, steps=STEPS),
    "multi-variant": partial(MultiVariant, fit_steps=2, steps=STEPS),
    "told": partial(MultiVariant, fit_steps=2, told=True),
    "maml": partial(Maml, fit_steps=2, tasks=2, rows=4, steps=STEPS),
    "set-encoder": partial(SetEncoder, fit_steps=2, tasks=2, rows=4),
    "history": partial(History, fit_steps=2, steps=STEPS, window=4, units=8, sequences=2),
}


def tiny_grid(*methods: str, **fields: Any) -> FewShotGrid:
    chosen = {name: TINY[name] for name in methods or TINY}
    return FewShotGrid(
        chosen,
        [SPLIT],
        **{"tiers": ["random"], "budgets": [Budget(1, 5)], "seeds": [0], "episodes": 2} | fields,
    )


@pytest.mark.usefixtures("small_datasets")
def test_one_tiny_cell_of_each_method(tmp_path: Path) -> None:
    lines = {line["method"]: line for line in run_few_shot(tiny_grid(), tmp_path)}
    assert set(lines) == set(METHODS)
    steps = {"scratch": ["1", "3"]} | {
        name: ["0", "1", "3"] for name in ("base-expert", "multi-variant", "maml", "history")
    }
    for name, line in lines.items():
        assert list(line["results"]) == steps.get(name, ["0"])
        for result in line["results"].values():
            assert len(result["returns"]) == 2
    # Experts and random policies score as such, whatever is demonstrated.
    assert lines["expert"]["results"]["0"]["returns"][0] > 2000
    assert lines["universal"]["results"]["0"]["returns"][0] > 2000
    assert lines["random"]["results"]["0"]["returns"][0] < 200


@pytest.mark.usefixtures("small_datasets")
def test_a_cell_is_a_pure_function_of_its_line(tmp_path: Path) -> None:
    """Other cells, their order and their processes change no number of a cell."""
    grid = tiny_grid("multi-variant", "scratch", budgets=[Budget(1, 5), Budget(2)])
    together = run_few_shot(grid, tmp_path / "together", jobs=2)
    alone = run_few_shot(tiny_grid("scratch", budgets=[Budget(2)]), tmp_path / "alone")
    (same,) = (line for line in together if (line["method"], line["budget"]) == ("scratch", "2xall"))
    assert same["results"] == alone[0]["results"]
    other_seed = run_few_shot(tiny_grid("scratch", budgets=[Budget(2)], seeds=[1]), tmp_path / "seed")
    assert other_seed[0]["results"] != alone[0]["results"]


@pytest.mark.usefixtures("small_datasets")
def test_a_killed_run_continues_and_computes_nothing_twice(tmp_path: Path) -> None:
    grid = tiny_grid("scratch", "random", budgets=[Budget(1, 5), Budget(2)])
    lines = run_few_shot(grid, tmp_path)
    path = tmp_path / FILE
    whole = path.read_text("utf-8").splitlines(keepends=True)
    assert len(lines) == grid.cells() == 3
    # Two methods and one dataset are stated before the lines that name them.
    assert len(whole) == 6
    path.write_text("".join(whole[:-1]) + whole[-1][:50], "utf-8")
    advanced: list[int] = []
    again = run_few_shot(grid, tmp_path, on_cells=advanced.append)
    assert advanced == [2, 1]
    assert [line["results"] for line in read_lines(path)] == [line["results"] for line in lines]
    assert sorted(again, key=identity) == sorted(read_lines(path), key=identity)


@pytest.mark.usefixtures("small_datasets")
def test_a_cell_that_is_asked_for_twice_is_computed_once(tmp_path: Path) -> None:
    (line,) = run_few_shot(tiny_grid("random", tiers=["random"] * 2), tmp_path)
    assert read_lines(tmp_path / FILE) == [line]


@pytest.mark.usefixtures("small_datasets")
def test_a_changed_dataset_or_setting_no_longer_matches(tmp_path: Path) -> None:
    lines = run_few_shot(tiny_grid("random", "expert"), tmp_path)
    assert changes(lines) == []
    assert changes([{**lines[0], "settings": {"rate": 0.5}}]) == [
        "the settings of random have changed (lines: 1)"
    ]
    publish("hopper-frictiondec_50_feet", tier="random", episodes=4, seed=7, force=True)
    (change,) = changes(lines)
    assert change.startswith("imujoco/hopper-frictiondec_50_feet-random-v0 is not the data of these lines: ")
    assert change.endswith(" (lines: 2)")
    advanced: list[int] = []
    run_few_shot(tiny_grid("random", "expert"), tmp_path, on_cells=advanced.append)
    assert advanced == [0, 1, 1]
    assert len(read_lines(tmp_path / FILE)) == 4


@pytest.mark.usefixtures("small_datasets")
def test_demonstrations_of_another_tier_leave_the_training_data(tmp_path: Path) -> None:
    publish("hopper-frictiondec_50_feet", tier="control", episodes=4, seed=9, policy=random_policy("hopper"))
    usual = run_few_shot(tiny_grid("multi-variant"), tmp_path)[0]
    other = run_few_shot(tiny_grid("multi-variant", demonstrations="control"), tmp_path)[0]
    assert (other["tier"], other["train_tier"]) == ("control", "random")
    assert "train_tier" not in usual
    assert other["train_sha256"] == usual["train_sha256"]
    assert other["data_sha256"] != usual["data_sha256"]
    # The same policy before the first step, and another after it.
    returns = [[line["results"][steps]["returns"] for steps in ("0", "3")] for line in (usual, other)]
    assert returns[0][0] == returns[1][0]
    assert returns[0][1] != returns[1][1]
    # The tiny settings differ from the package's; the data do not.
    assert changes([usual, other]) == ["the settings of multi-variant have changed (lines: 2)"]


@pytest.mark.usefixtures("small_datasets")
def test_lines_whose_datasets_are_missing_are_not_compared(root: Path, tmp_path: Path) -> None:
    lines = run_few_shot(tiny_grid("random"), tmp_path)
    root.rename(tmp_path / "elsewhere")
    assert changes(lines) == ["not compared, because their datasets are not in the Minari root (lines: 1)"]


class Still:
    """A method of a user: it stands still, whatever is demonstrated."""

    def __init__(self, seed: int) -> None:
        self.force = 0.0

    def adapt(self, demonstrations: Arrays) -> Any:
        return lambda observation: np.full(3, self.force)


@pytest.mark.usefixtures("small_datasets")
def test_a_method_of_a_user_needs_no_more_than_adapt(tmp_path: Path) -> None:
    grid = FewShotGrid({"still": Still}, [SPLIT], ["random"], [Budget(1, 5)], [0], episodes=2)
    (line,) = run_few_shot(grid, tmp_path)
    assert line["settings"] == {"force": 0.0}
    assert line["train_sha256"] == ""
    assert line["results"]["0"]["error"] == 1.0


class Returning(Still):
    """Returns what it is told to."""

    policies: Mapping[str, Any] = {}

    def adapt(self, demonstrations: Arrays) -> Any:
        return self.policies["mine"]


@pytest.mark.usefixtures("small_datasets")
@pytest.mark.parametrize(
    ("policies", "fault"),
    [
        ({}, "after these steps: none"),
        ({"a": random_policy("hopper")}, "after these steps: 'a'"),
        (lambda observation: np.full(3, np.nan), "not finite"),
    ],
)
def test_what_a_method_returns_is_checked_before_it_is_written(
    tmp_path: Path, policies: Any, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Returning, "policies", {"mine": policies})
    grid = FewShotGrid({"mine": Returning}, [SPLIT], ["random"], [Budget(1, 5)], [0], episodes=2)
    with pytest.raises(BenchmarkError, match=f"mine, {SPLIT.test[0]}, 1x5, seed 0: .*{fault}"):
        run_few_shot(grid, tmp_path)
    assert not read_lines(tmp_path / FILE)


class Settings:
    """Attributes of many kinds."""

    def __init__(self, seed: int, rate: float = 0.1, steps: int = 5) -> None:
        self.seed, self.rate, self.steps = seed, rate, steps
        self.layers, self.size, self.derived = [64, np.int64(8)], np.float32(0.5), 3
        self.weights, self._hidden = [np.zeros(2)], 1

    def adapt(self, demonstrations: Arrays) -> Any:
        raise NotImplementedError


def test_settings_are_the_plain_attributes_and_those_of_the_constructor_can_change() -> None:
    plain = {"rate": 0.1, "steps": 5, "layers": [64, 8], "size": 0.5, "derived": 3}
    assert settings_of(Settings(0)) == plain
    assert json.loads(json.dumps(settings_of(Settings(0)))) == plain
    changed = with_settings(Settings, ["rate=0.2", "steps=7"])
    assert settings_of(changed(0)) == plain | {"rate": 0.2, "steps": 7}
    with pytest.raises(BenchmarkError, match="no setting 'derived=4'; valid: rate, steps"):
        with_settings(Settings, ["derived=4"])
    for text in ("rate=-1", "rate=nan", "rate=inf", "steps=0.5"):
        with pytest.raises(BenchmarkError, match=f"'{text}' is not a (finite|whole) number from 0"):
            with_settings(Settings, [text])


def test_a_split_of_several_robots_is_refused() -> None:
    with pytest.raises(BenchmarkError, match="robots-hopper-v1 has several robots"):
        FewShotGrid({"still": Still}, [held_out("robots-hopper-v1")])


def test_methods_are_found_by_name() -> None:
    assert find_method("scratch") is Scratch
    assert find_method("imujoco_minari.benchmark.meta:Maml") is Maml
    with pytest.raises(BenchmarkError, match=r"no method 'scrath' \(did you mean 'scratch'\?\)"):
        find_method("scrath")
    with pytest.raises(BenchmarkError, match=r"JSONDecoder has no method adapt\(demonstrations\)"):
        find_method("json:JSONDecoder")
    for name in ("no.such.module:Method", "json:Method", ".meta:Maml", ":Maml"):
        with pytest.raises(BenchmarkError, match="no method"):
            find_method(name)


def test_a_variant_that_is_not_held_out_is_refused() -> None:
    with pytest.raises(
        BenchmarkError, match="hopper-base is not held out; valid: hopper-frictiondec_50_feet"
    ):
        tiny_grid("random", variants=["hopper-base"])


def test_a_damaged_line_is_named(tmp_path: Path) -> None:
    path = tmp_path / FILE
    append_lines(path, [{"results": {}}])
    path.write_text(path.read_text("utf-8") + json.dumps([1]) + "\n", "utf-8")
    with pytest.raises(BenchmarkError, match="line 3: not a result"):
        read_lines(path)


def test_a_results_file_that_cannot_be_written_is_found_before_the_first_cell(tmp_path: Path) -> None:
    (tmp_path / "results").write_text("no folder", "utf-8")
    computed: list[Line] = []

    def compute(lines: Sequence[Line]) -> Iterable[Line]:
        computed.extend(lines)
        return []

    with pytest.raises(StorageError, match="cannot write"):
        run_lines(tmp_path / "results" / FILE, compute, [{"method": "m"}], lambda cells: None)
    assert not computed


class Faster:
    """A method whose policies after each number of steps are functions that differ."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def adapt(self, demonstrations: Arrays) -> Mapping[int, Any]:
        return {steps: partial(self.push, steps / 10) for steps in range(6)}

    def push(self, force: float, observation: Any) -> Any:
        return np.full(3, force)


@pytest.mark.usefixtures("small_datasets")
def test_policies_without_a_digest_are_never_taken_for_each_other(tmp_path: Path) -> None:
    grid = FewShotGrid({"faster": Faster}, [SPLIT], ["random"], [Budget(1, 5), Budget(2)], [0], episodes=2)
    for line in run_few_shot(grid, tmp_path):
        assert len({str(result["returns"]) for result in line["results"].values()}) == 6
