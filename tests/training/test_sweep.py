"""Training, tiny but real: resumed to the bit, warm-started, finished once, and usable at once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest
from tiny_training import TINY

from imujoco_minari.cli.training import describe_trained
from imujoco_minari.errors import PolicyError, PolicyNotFoundError, TrainingError
from imujoco_minari.policies import expert_actor, expert_record, expert_variants, policies_folder
from imujoco_minari.policies.evaluation import Evaluation, evaluate
from imujoco_minari.policies.experts import FOLDED
from imujoco_minari.policies.references import CONFIRMING_SEED, ladder
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.training import selection, starts, sweep
from imujoco_minari.training.agents import (
    STARTING,
    actor_of,
    actor_weights,
    agent_actor,
    agent_arrays,
    load_arrays,
    make_agent,
    restore_agent,
    save_arrays,
)
from imujoco_minari.training.hyperparameters import SCRATCH, WARM, hyperparameters
from imujoco_minari.training.run import Run
from imujoco_minari.training.selection import CHOOSING_SEED, Look
from imujoco_minari.training.sweep import Trained, train, train_all
from imujoco_minari.training.task import Plan, Task
from imujoco_minari.variants import Variant, catalogue

BASE = Variant.parse("hopper-base")
LIGHT_LEG = Variant.parse("hopper-massdec_25_leggeom")

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(autouse=True)
def few_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare the starts of a training in two episodes each, and try two listed contexts."""
    monkeypatch.setattr(starts, "EPISODES", 2)
    monkeypatch.setattr(starts, "catalogue", lambda robot: catalogue(robot)[:2])


def test_a_killed_run_ends_in_the_weights_of_one_that_was_not(tmp_path: Path) -> None:
    task = Task(LIGHT_LEG, hyperparameters("hopper", WARM, **TINY | {"settling_from": 0.5}))
    whole = Run(task, tmp_path / "whole")
    whole.train()
    broken = Run(task, tmp_path / "broken")
    # Killed after the third of four intervals, before the rate falls: what is left is on the disk.
    for _ in range(3):
        broken.train_interval()
    resumed = Run(task, tmp_path / "broken")
    assert resumed.progress.steps == broken.progress.steps >= 250
    resumed.train()
    ours, theirs = (load_arrays(tmp_path / name / "checkpoint.safetensors") for name in ("whole", "broken"))
    assert set(ours) == set(theirs)
    differing = [name for name in ours if name != "progress" and not np.array_equal(ours[name], theirs[name])]
    assert differing == []
    records = [run.make_record() | {"wall_seconds": 0} for run in (whole, resumed)]
    assert records[0] == records[1]


@pytest.mark.parametrize("better", [False, True])
def test_the_better_of_own_and_folded_is_the_expert(
    better: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unlisted = Variant.parse("hopper-massdec_26_leggeom")
    monkeypatch.setattr(sweep, "present_scores", lambda *_: (-1e9, -1e9 if better else 1e9))
    start = replace(sweep.best_start(unlisted, tmp_path, 0), told=str(LIGHT_LEG))
    monkeypatch.setattr(sweep, "best_start", lambda *_: start)
    plan = Plan(tmp_path / "state", changes=TINY, target=1e9)
    (outcome,) = train_all([unlisted], plan)
    assert (outcome.created, outcome.error) == (better, "")
    assert ("steps" in expert_record(unlisted)) == better
    assert bool(outcome.tried) == (not better)
    # Neither outcome is trained for again.
    monkeypatch.setattr(sweep, "Run", lambda *_, **__: pytest.fail("it is trained again"))
    (again,) = train_all([unlisted], plan)
    assert not again.created
    assert again.record["weights_sha256"] == outcome.record["weights_sha256"]
    assert again.tried.get("kept_score") == outcome.tried.get("kept_score") == (None if better else 1e9)


@pytest.mark.parametrize("other", [False, True])
def test_a_start_from_the_universal_policy_is_an_expert_of_its_own_if_it_was_told_another_variant(
    other: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unlisted = Variant.parse("hopper-massdec_26_leggeom")
    told = str(LIGHT_LEG if other else unlisted)
    start = replace(sweep.best_start(unlisted, tmp_path, 0), name=FOLDED, told=told)
    monkeypatch.setattr(sweep, "best_start", lambda *_: start)
    monkeypatch.setattr(sweep, "present_scores", lambda *_: (-1e9, -1e9))
    (outcome,) = train_all([unlisted], Plan(tmp_path / "state", changes=TINY, target=-1e9))
    assert (outcome.created, outcome.error) == (other, "")
    record = outcome.record if other else outcome.tried
    assert (record["start"], record["start_told"], record["steps_trained"]) == (FOLDED, told, 0)
    assert bool(list(policies_folder().glob(f"{unlisted}*"))) == other


def test_a_variant_is_trained_from_its_base_and_published(tmp_path: Path, unshipped: None) -> None:
    plan = Plan(tmp_path / "state", changes=TINY, target=1e9)
    outcomes = list(train_all([LIGHT_LEG, BASE], plan))
    assert [(outcome.variant, outcome.created, outcome.error) for outcome in outcomes] == [
        (BASE, True, ""),
        (LIGHT_LEG, True, ""),
    ]
    record = dict(expert_record(LIGHT_LEG))
    assert record["start"] == "hopper-base"
    assert record["algorithm"] == "CrossQ"
    assert record["steps_trained"] >= 350
    assert set(expert_variants()) >= {BASE, LIGHT_LEG}
    # The record's evaluation is that of the very weights that lie beside it.
    actor = expert_actor(LIGHT_LEG)
    assert actor.sha256 == record["weights_sha256"]
    measured = evaluate(LIGHT_LEG, actor, episodes=3, seed=CONFIRMING_SEED)
    assert measured.asdict() == record["evaluation"]
    # Its ladder is that of its robot, measured when a tier first needs it.
    assert "ladder" not in record
    assert {rung["steps"] for rung in ladder(LIGHT_LEG)} == {
        rung["steps"] for rung in expert_record(BASE)["ladder"]
    }
    assert expert_record(LIGHT_LEG)["ladder"]
    # A finished one is never trained again.
    before = sorted((path.name, path.stat().st_mtime_ns) for path in policies_folder().iterdir())
    assert [outcome.created for outcome in train_all([LIGHT_LEG, BASE], plan)] == [False, False]
    assert sorted((path.name, path.stat().st_mtime_ns) for path in policies_folder().iterdir()) == before
    # Unless it is asked for, and then what is worse is not kept.
    (improved,) = train_all([BASE], replace(plan, improve=True, seed=1))
    # Both are compared on the episodes that select actors, not on those of the records.
    tried = improved.record if improved.created else improved.tried
    first, second = (record["selection"] for record in (outcomes[0].record, tried))
    assert first["seed"] == second["seed"] == CHOOSING_SEED != outcomes[0].record["evaluation"]["seed"]
    score = [(each["return_mean"] + each["return_min"]) / 2 for each in (first, second)]
    assert improved.error == ""
    assert improved.created == (score[1] > score[0])
    assert improved.created == (not improved.tried)
    assert expert_actor(BASE).sha256 == expert_record(BASE)["weights_sha256"]
    if improved.created:
        assert improved.record["before"]["weights_sha256"] == outcomes[0].record["weights_sha256"]
        assert improved.record["before"]["evaluation"] == outcomes[0].record["evaluation"]
        assert improved.record["start_sha256"] == outcomes[0].record["weights_sha256"]
    # An improved base keeps its first ladder.
    assert expert_record(BASE)["ladder"] == outcomes[0].record["ladder"]
    assert not (tmp_path / "state" / "hopper-base").exists()
    published = publish(LIGHT_LEG, episodes=3)
    metadata = minari.load_dataset(published.dataset_id).storage.metadata
    assert metadata["algorithm_name"] == "CrossQ"
    assert metadata["ref_max_score"] == record["evaluation"]["return_mean"]
    assert metadata["ref_min_score"] == record["random"]["return_mean"]


def test_an_agent_is_restored_whole_or_refused_on_a_device_that_is_there(tmp_path: Path) -> None:
    settings = hyperparameters("hopper", WARM, **TINY)
    agent = make_agent(11, 3, settings, seed=1)
    save_arrays(tmp_path / "agent.safetensors", agent_arrays(agent))
    other = make_agent(11, 3, settings, seed=2, device="cpu")
    arrays = load_arrays(tmp_path / "agent.safetensors")
    restore_agent(other, arrays)
    assert {name: array.tobytes() for name, array in agent_arrays(other).items()} == {
        name: array.tobytes() for name, array in arrays.items()
    }
    # A new run takes the weights, and begins with optimisers of its own.
    third = make_agent(11, 3, settings, seed=3)
    restore_agent(third, arrays, STARTING)
    same = {name for name, array in agent_arrays(third).items() if np.array_equal(array, arrays[name])}
    assert same >= {name for name in arrays if name.startswith(STARTING)}
    assert "key" not in same
    name = "actor/params/Dense_1/kernel"
    with pytest.raises(PolicyError, match=f"does not fit: {name}"):
        restore_agent(other, arrays | {name: arrays[name][1:]})
    with pytest.raises(TrainingError, match=r"no device 'abacus' here; valid: .*cpu"):
        make_agent(11, 3, settings, seed=0, device="abacus")


def test_two_processes_do_not_train_one_variant(tmp_path: Path) -> None:
    import fcntl

    variant = Variant.parse("hopper-massinc_11_leggeom")
    folder = tmp_path / "state" / str(variant)
    folder.mkdir(parents=True)
    with (folder / "lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(TrainingError, match="hopper-massinc_11_leggeom is being trained"):
            train(variant, Plan(tmp_path / "state", tmp_path / "policies", scratch=True, changes=TINY))


def test_a_variant_without_a_base_agent_says_what_to_train_first(tmp_path: Path, unshipped: None) -> None:
    with pytest.raises(
        PolicyNotFoundError, match="`imujoco train hopper-base` first, or train with --scratch"
    ):
        train(LIGHT_LEG, Plan(tmp_path / "state"))


def test_the_rate_falls_by_a_cosine_from_the_middle_to_the_end() -> None:
    settings = hyperparameters("hopper", SCRATCH, max_steps=1000, settling_rate=1e-4)
    rates = [settings.rate(steps) for steps in (0, 500, 625, 750, 875, 1000, 1100)]
    assert rates[:2] == [1e-3, 1e-3]
    assert rates[3] == pytest.approx(5.5e-4)
    assert rates[2] - rates[3] == pytest.approx(rates[3] - rates[4])
    assert rates[5] == rates[6] == pytest.approx(1e-4)


def test_a_run_settles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        type(hyperparameters("hopper", WARM)), "rate", lambda settings, steps: 1e-3 * (steps < 260)
    )
    run = Run(Task(BASE, hyperparameters("hopper", WARM, **TINY | {"max_steps": 450})), tmp_path)
    steps = [0]
    while not run.finished:
        run.train_interval()
        steps.append(run.progress.steps)
    assert steps == [0, 100, 160, 260, 360, 460]
    learning, settled, after = (
        load_arrays(tmp_path / "ladder" / f"{steps}.safetensors") for steps in (260, 360, 460)
    )
    # At a rate of nothing, nothing is learnt.
    assert all(np.array_equal(settled[name], after[name]) for name in settled)
    assert all(np.array_equal(learning[name], settled[name]) for name in settled)
    first = actor_weights(Run(run.task, tmp_path / "other")._agent)
    assert not all(np.array_equal(first[name].astype(np.float16), after[name]) for name in after)
    run.close()


def test_the_averaged_weights_are_another_candidate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imujoco_minari.training.run._AVERAGED_CALLS", 1)
    run = Run(Task(BASE, hyperparameters("hopper", SCRATCH, **TINY, average=0.9)), tmp_path)
    begun = {name: array.copy() for name, array in run._average.items()}
    for _ in range(3):
        run.train_interval()
    present, name = actor_weights(run._agent), "mu.weight"
    # Five calls of the update loop, each of which moves the average a tenth of the way.
    assert run.progress.updates == 45
    moved = np.linalg.norm(run._average[name] - begun[name])
    assert 0.1 < moved / np.linalg.norm(present[name] - begun[name]) < 0.5
    # From here on the average stays what it is.
    monkeypatch.setattr("imujoco_minari.training.run._AVERAGED_CALLS", 10**9)
    monkeypatch.setattr(run, "_average", {key: 0 * array for key, array in begun.items()})
    monkeypatch.setattr(
        selection,
        "evaluate",
        lambda env, actor, episodes, seed: _evaluation(0.0 if actor.weights[name].any() else 9e3, episodes),
    )
    run.train_interval()
    assert run.progress.evaluations[-1]["best"] == "average"
    assert not any(array.any() for array in agent_actor(run.best_agent()).values())
    run.close()


def _evaluation(value: float, episodes: int) -> Evaluation:
    return Evaluation(np.full(episodes, value), np.ones(episodes), (), 0, True)


def test_a_near_start_is_held_to_what_it_began_as(tmp_path: Path) -> None:
    task = sweep.task(LIGHT_LEG, Plan(tmp_path, tmp_path, changes=TINY))
    seen = np.array([1.25, *[0.0] * 10]) + 0.1 * np.random.default_rng(0).normal(size=(200, 11))
    begun = actor_of(agent_actor(task.start.agent), "hopper").act(seen, np.random.default_rng(0))

    def moved(alpha: float) -> float:
        settings = replace(task.settings, anchor=alpha, exploration_steps=60, learning_rate=1e-3)
        run = Run(replace(task, settings=settings, target=1e9), tmp_path / str(alpha))
        for _ in range(4):
            run.train_interval()
        actor = actor_of(actor_weights(run._agent), "hopper")
        run.close()
        return float(np.abs(actor.act(seen, np.random.default_rng(0)) - begun).mean())

    assert 0 < moved(0.001) < 0.8 * moved(0.0)


def test_an_actor_that_seems_the_best_is_looked_at_longer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = Task(BASE, hyperparameters("hopper", SCRATCH, **TINY))
    run = Run(task, tmp_path)
    looks: list[int] = []

    def looked(task: Task, arrays: Any, episodes: int, seed: int) -> Look:
        looks.append(episodes)
        # Better and better in two episodes. In the third it falls, so the lowest return is 30 below the mean.
        mean, low = {1: (50.0, 50.0), 2: (50.0 + len(looks), 50.0), 3: (55.0, 25.0)}[episodes]
        return Look({"return_mean": mean, "return_min": low}, mean, (mean + low) / 2)

    for module in ("selection", "run"):
        monkeypatch.setattr(f"imujoco_minari.training.{module}.look", looked)
    # Two intervals only explore.
    for _ in range(4):
        run.train_interval()
    # Two evaluations of present and averaged weights. Only the first is better than the best.
    assert looks == [1, 2, 3] * 4
    assert run.progress.best_score == 40.0
    assert run.progress.best_steps == 260
    run.close()


def test_a_run_that_ends_before_its_first_update_has_an_actor(tmp_path: Path) -> None:
    settings = hyperparameters("hopper", SCRATCH, **TINY | {"max_steps": 1})
    run = Run(Task(BASE, settings), tmp_path)
    run.train()
    record = run.make_record()
    run.close()
    assert record["updates"] == 0
    assert record["evaluation"]["return_mean"] > 0


def test_a_score_below_zero_is_improved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run(Task(BASE, hyperparameters("hopper", SCRATCH, **TINY)), tmp_path)
    # The last mean is worth no second look.
    for value, best in ((-100.0, -100.0), (-99.0, -99.0), (-101.5, -99.0)):
        found = _evaluation(value, 1)
        monkeypatch.setattr(selection, "evaluate", lambda *_, found=found, **__: found)
        run._evaluate(0.0)
        assert run.progress.best_score == best
    run.close()


@pytest.mark.parametrize(("share", "rate", "anchor"), [(0.89, 1e-3, 0), (0.95, 3e-4, 20)])
def test_a_near_start_takes_smaller_steps_and_is_held(
    share: float, rate: float, anchor: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = 0.96 * expert_record(BASE)["evaluation"]["return_mean"]
    start = replace(sweep.best_start(LIGHT_LEG, tmp_path, 0), score=share * asked)
    monkeypatch.setattr(sweep, "best_start", lambda *_: start)
    task = sweep.task(LIGHT_LEG, Plan(tmp_path))
    assert task.target == pytest.approx(asked)
    assert task.settings.anchor == anchor
    assert task.settings.rate(0) == task.settings.learning_rate == rate
    assert task.settings.rate(task.settings.max_steps) == task.settings.settling_rate == 1e-4


@pytest.mark.parametrize(
    ("share", "start", "command"),
    [
        (0.49, "universal policy", "imujoco train hopper-massdec_25_leggeom --scratch --improve"),
        (0.49, "scratch", "imujoco train hopper-massdec_25_leggeom --improve --seed 1"),
        (0.51, "universal policy", ""),
    ],
)
def test_a_weak_outcome_says_what_may_do_better(
    share: float, start: str, command: str, tmp_path: Path
) -> None:
    record = dict(expert_record(LIGHT_LEG)) | {"start": start}
    mean = share * expert_record(BASE)["evaluation"]["return_mean"]
    record["evaluation"] = record["evaluation"] | {"return_mean": mean}
    tried = record | {"score": mean, "kept_score": mean}
    for outcome in (Trained(LIGHT_LEG, record, created=True), Trained(LIGHT_LEG, record, tried=tried)):
        printed = " ".join(describe_trained(outcome, Plan(tmp_path)))
        assert (command in printed) if command else ("may do better" not in printed)


def test_a_run_that_does_not_beat_a_folded_policy_without_evaluation_is_described(tmp_path: Path) -> None:
    """Only the listed variants have an evaluation of the folded policy."""
    variant = Variant.parse("hopper-massinc_37_torsogeom")
    tried = dict(expert_record(variant.base)) | {"score": 3210.06, "kept_score": 3399.2}
    outcome = Trained(variant, dict(expert_record(variant)), tried=tried)
    assert "evaluation" not in outcome.record
    printed = " ".join(describe_trained(outcome, Plan(tmp_path)))
    assert (
        "kept hopper-massinc_37_torsogeom: the policy folded from the universal policy; not better: return"
        in printed
    )
    assert "mean of mean and lowest return, on the same episodes: 3399.2 and 3210.1" in printed
