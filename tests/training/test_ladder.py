"""Ladders: which rungs are kept, measured and added. Each actor here scores what its bias says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imujoco_minari.cli.training import _teller, describe_trained
from imujoco_minari.policies import Actor, load_policy
from imujoco_minari.policies.evaluation import Evaluation
from imujoco_minari.policies.rungs import has_even_ranks, has_medium, medium_rung, rung_file
from imujoco_minari.policies.standing import standings
from imujoco_minari.training import installing, ladder
from imujoco_minari.training.agents import save_arrays
from imujoco_minari.training.ladder import Ladder, climb_task
from imujoco_minari.training.plan import Plan
from imujoco_minari.training.run import Progress
from imujoco_minari.training.sweep import train
from imujoco_minari.training.task import Task
from imujoco_minari.variants import Variant

BASE = Variant.parse("hopper-base")
VARIANT = Variant.parse("hopper-massinc_37_torsogeom")


def save_actor(path: Path, value: float) -> None:
    weights: dict[str, Any] = {}
    for name, shape in {"latent_pi.0": (4, 11), "mu": (3, 4), "log_std": (3, 4)}.items():
        weights[f"{name}.weight"] = np.zeros(shape, np.float32)
        weights[f"{name}.bias"] = np.full(shape[0], value, np.float32)
    save_arrays(path, weights)


@pytest.fixture(autouse=True)
def scores(monkeypatch: pytest.MonkeyPatch, unshipped: None) -> dict[tuple[float, int], float]:
    """Let an actor score its bias, or what this mapping states for a bias and a number of episodes."""
    other: dict[tuple[float, int], float] = {}

    def evaluate(env: object, actor: Actor, *, episodes: int, seed: int) -> Evaluation:
        value = float(actor.weights["mu.bias"][0])
        value = other.get((value, episodes), value)
        return Evaluation(np.full(episodes, value), np.ones(episodes), ("",) * episodes, seed, True)

    monkeypatch.setattr(ladder, "evaluate", evaluate)
    monkeypatch.setattr(installing, "evaluate", evaluate)
    return other


def expert(variant: Variant, rungs: list[dict[str, Any]] | None = None) -> dict[str, Any]:
    """A record of an expert that scores 1000."""
    return {
        "variant": str(variant),
        "algorithm": "CrossQ",
        "wall_seconds": 3600.0,
        "evaluation": {"return_mean": 1000.0, "episodes": 100},
        "ladder": rungs or [],
    }


def write_base(plan: Plan, values: list[float]) -> None:
    """Write a base whose ladder has a rung for each value."""
    for value in values:
        save_actor(plan.policies / rung_file(BASE, int(value)), value)
    entries = [{"steps": int(value), "evaluation": {"return_mean": value}} for value in values]
    save_actor(plan.policies / f"{BASE}.safetensors", 1000.0)
    (plan.policies / f"{BASE}.json").write_text(json.dumps(expert(BASE, entries)))


def checkpoints(folder: Path, values: list[float]) -> list[dict[str, Any]]:
    """Write a run's checkpoints and return its evaluations."""
    for number, value in enumerate(values, start=1):
        save_actor(folder / "ladder" / f"{number}.safetensors", value)
    return [{"steps": number, "return_mean": value} for number, value in enumerate(values, start=1)]


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    (tmp_path / "policies").mkdir()
    return Plan(tmp_path / "state", tmp_path / "policies")


def known_ladder(plan: Plan) -> Ladder:
    """The ladder of the variant, of the rungs that its base lists."""
    built = Ladder(VARIANT, 1000.0, plan.policies)
    built.add_known()
    return built


def returns(rungs: list[dict[str, Any]]) -> list[float]:
    return [rung["evaluation"]["return_mean"] for rung in rungs]


def test_a_base_keeps_the_checkpoint_nearest_to_each_share(plan: Plan) -> None:
    evaluations = checkpoints(plan.state, [0.0, 55.0, 149.0, 260.0, 440.0, 800.0, 1000.0])
    built = Ladder(BASE, 1000.0, plan.policies)
    built.add_spread(plan.state / "ladder", evaluations)
    assert [rung["steps"] for rung in built.rungs] == [2, 3, 4, 5, 6]
    assert all((plan.policies / rung_file(BASE, rung["steps"])).is_file() for rung in built.rungs)


def test_the_medium_rung_is_measured_in_a_hundred_episodes(
    plan: Plan, scores: dict[tuple[float, int], float]
) -> None:
    write_base(plan, [200.0, 410.0, 470.0, 600.0, 800.0])
    # In a hundred episodes the rung that seemed nearest is not, and the next is.
    scores[410.0, 100] = 350.0
    rungs = known_ladder(plan).rungs
    assert returns(rungs) == [200.0, 350.0, 470.0, 600.0, 800.0]
    assert [rung["evaluation"]["episodes"] for rung in rungs] == [10, 100, 100, 10, 10]
    assert medium_rung(rungs, 1000.0)["steps"] == 470


def test_checkpoints_of_the_own_run_fill_what_the_base_lacks(
    plan: Plan, scores: dict[tuple[float, int], float]
) -> None:
    write_base(plan, [100.0, 190.0, 700.0])
    # 595 scores 900 when it is measured again, and 990 is near to nothing that is needed.
    evaluations = checkpoints(plan.state, [180.0, 400.0, 430.0, 595.0, 820.0, 990.0])
    scores[595.0, 10] = 900.0
    record = expert(VARIANT)
    built = known_ladder(plan)
    built.add_missing(plan.state / "ladder", evaluations)
    rungs = built.rungs
    assert sorted(returns(rungs)) == [100.0, 190.0, 430.0, 700.0, 820.0]
    own = {rung["steps"] for rung in rungs if rung.get("run") == str(VARIANT)}
    assert own == {3, 5}
    assert {path.name for path in plan.policies.glob(f"{VARIANT}*")} == {rung_file(VARIANT, s) for s in own}
    assert has_medium(record | {"ladder": rungs})
    assert has_even_ranks(record | {"ladder": rungs})
    assert not has_even_ranks(record | {"ladder": [rung for rung in rungs if rung["steps"] != 5]})


class Climbing:
    """A run whose actors score 100 more with each interval."""

    def __init__(self, task: Task, folder: Path, device: str | None) -> None:
        self.task, self.folder, self.progress = task, folder, Progress()

    @property
    def finished(self) -> bool:
        return self.progress.steps >= 8

    def train_interval(self) -> None:
        self.progress.steps += 1
        value = 100.0 * self.progress.steps
        save_actor(self.folder / "ladder" / f"{self.progress.steps}.safetensors", value)
        self.progress.evaluations.append({"steps": self.progress.steps, "return_mean": value})

    def close(self) -> None:
        pass


@pytest.mark.parametrize(
    ("values", "intervals", "found"),
    [([430.0], 0, [430.0]), ([100.0, 900.0], 4, [100.0, 900.0, 200.0, 400.0]), ([], 4, [200.0, 400.0])],
)
def test_a_climb_ends_at_the_medium_rung(
    values: list[float], intervals: int, found: list[float], plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ladder, "Run", Climbing)
    write_base(plan, values)
    seen: list[int] = []
    built = known_ladder(plan)
    built.climb(plan, plan.state, lambda progress, settings: seen.append(progress.steps))
    assert len(seen) == intervals
    assert returns(built.rungs) == found


def test_rungs_of_other_variants_are_tried_before_a_climb(
    plan: Plan, scores: dict[tuple[float, int], float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ladder, "Run", Climbing)
    write_base(plan, [100.0, 900.0])
    other = Variant.parse("hopper-massdec_12_leggeom")
    for value in (610.0, 700.0, 390.0, 400.0):
        save_actor(plan.policies / rung_file(other, int(value)), value)
    entries = [{"run": str(other), "steps": steps} for steps in (610, 700, 390, 400)]
    (plan.policies / f"{other}.json").write_text(json.dumps(expert(other, [{"steps": 100}, *entries])))
    # In ten episodes 390 seems to be a medium rung, and in a hundred it is not.
    scores[390.0, 100] = 290.0
    built = known_ladder(plan)
    built.climb(plan, plan.state, lambda progress, settings: pytest.fail("nothing is missing"))
    assert [rung.get("run") for rung in built.rungs] == [None, None, str(other), str(other), str(other)]
    assert returns(built.rungs) == [100.0, 900.0, 610.0, 290.0, 400.0]
    assert has_medium(expert(VARIANT, built.rungs))
    # They stay when the ladder is measured again, and they are no rungs of the variant's own.
    (plan.policies / f"{VARIANT}.json").write_text(json.dumps(expert(VARIANT, built.rungs)))
    again = known_ladder(plan).rungs
    assert [rung["steps"] for rung in again] == [rung["steps"] for rung in built.rungs]
    assert not list(plan.policies.glob(f"{VARIANT}.rung*"))


def test_a_ladder_is_renewed_without_training_the_expert(
    plan: Plan, monkeypatch: pytest.MonkeyPatch, home: Path
) -> None:
    monkeypatch.setattr(ladder, "Run", Climbing)
    write_base(plan, [50.0, 900.0])
    plan = Plan(plan.state, plan.policies, ladders=True)
    outcome = train(BASE, plan)
    assert outcome.measured
    assert not outcome.created
    assert "6 rungs, medium at 0.40 of the expert's return" in " ".join(describe_trained(outcome, plan))
    # A base gets all rungs that tiers need, because its variants use them too.
    assert sorted(returns(outcome.record["ladder"])) == [50.0, 200.0, 400.0, 600.0, 800.0, 900.0]
    written = json.loads((plan.policies / f"{BASE}.json").read_text())
    assert written == outcome.record
    assert has_medium(written)
    assert has_even_ranks(written)
    (standing,) = standings(["hopper"], ["base"], plan.policies)
    assert (standing.medium, standing.ranked) == (1, 1)
    assert not (plan.state / str(BASE)).exists()
    # The rungs of a base are those of its variants, and a tier finds them.
    home.mkdir()
    plan.policies.rename(home / "policies")
    assert load_policy(BASE, tier="medium").algorithm == "CrossQ"
    steps = [rung["steps"] for rung in known_ladder(Plan(plan.state, home / "policies")).rungs]
    assert steps == [rung["steps"] for rung in written["ladder"]]
    assert sorted(steps) == [2, 4, 6, 8, 50, 900]


def test_a_climb_is_short_and_never_longer_than_the_user_allows(plan: Plan) -> None:
    task = climb_task(VARIANT, plan)
    assert task.settings.max_steps == 150_000
    assert task.settings.deciding_episodes == task.settings.ranking_episodes == 5
    assert task.settings.rate(0) == task.settings.rate(149_999) == 1e-3
    short = Plan(plan.state, plan.policies, changes={"max_steps": 1000, "ranking_episodes": 2})
    assert climb_task(VARIANT, short).settings.max_steps == 1000
    assert climb_task(VARIANT, short).settings.choosing_episodes == 2


def test_a_line_of_progress_says_that_a_climb_trains_no_expert(
    plan: Plan, capsys: pytest.CaptureFixture[str]
) -> None:
    climb = climb_task(VARIANT, plan)
    state = Progress(steps=2000, evaluations=[{"steps": 2000, "return_mean": 300.0, "return_std": 4.0}])
    for task in (climb, replace(climb, purpose="")):
        _teller(quiet=False)(state, task)
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition("left")[2] for line in lines] == [", for the lower tiers", ""]
