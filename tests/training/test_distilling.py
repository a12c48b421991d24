"""Training a universal policy: in many variants, teachers, distilling, drawn variants, and resuming."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imujoco_minari.policies import Actor, expert_actor, own_record, universal_policy
from imujoco_minari.policies.experts import agent_file
from imujoco_minari.policies.universal import FIRST_WEIGHT
from imujoco_minari.storage.files import write_json
from imujoco_minari.training import starts, universal
from imujoco_minari.training.agents import agent_actor, load_arrays, save_arrays
from imujoco_minari.training.critics import with_context
from imujoco_minari.training.distilling import Distilling, Lesson, best_teacher, distil
from imujoco_minari.training.run import Progress
from imujoco_minari.training.selection import universal_of
from imujoco_minari.training.starts import best_start
from imujoco_minari.training.task import Plan, Task
from imujoco_minari.training.universal import drawn_variant, train_universal
from imujoco_minari.variants import CATEGORIES, Variant, catalogue
from imujoco_minari.variants.context import parameters
from imujoco_minari.variants.ranges import drawing_ranges

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

BASE, HEAVY = Variant("hopper"), Variant.parse("hopper-massinc_200_torsogeom")
SMALL = Distilling(rounds=2, steps=60, updates=400)
# Where the weights need not be good.
QUICK = Distilling(rounds=2, steps=20, updates=10)


def lesson(variant: Variant) -> Lesson:
    return Lesson(variant, expert_actor(variant), 1.0)


def silent() -> Actor:
    """An actor that always chooses 0."""
    return Actor({name: 0 * array for name, array in expert_actor(BASE).weights.items()})


def test_the_student_is_told_its_variant_and_acts_as_its_teacher() -> None:
    lessons, lines = [lesson(BASE), Lesson(HEAVY, silent(), 0.1)], []
    path = agent_file(BASE)
    assert path is not None
    count, rng = len(parameters("hopper")), np.random.default_rng(0)
    agent = with_context(load_arrays(path), np.zeros((1, count)), "hopper")
    start = universal_of(agent_actor(agent), "hopper").actor
    weights = distil(lessons, start, SMALL, lines.append)
    assert [line[:8] for line in lines] == ["round 1:", "round 2:"]
    once, again = (distil(lessons, start, QUICK) for _ in range(2))
    assert all(np.array_equal(array, once[name]) for name, array in again.items())
    student = universal_of(weights, "hopper")
    seen = np.array([[1.25, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]]) + 0.005 * rng.standard_normal((50, 11))
    in_base, in_heavy = (student.fold(each).act(seen, rng) for each in (BASE, HEAVY))
    assert np.abs(in_base - expert_actor(BASE).act(seen, rng)).mean() < 0.1
    assert np.abs(in_heavy).mean() < 0.1
    assert np.abs(in_base).mean() > 0.4


def test_the_best_of_several_policies_teaches() -> None:
    walker = Variant("walker2d")
    still = Actor({name: 0 * array for name, array in expert_actor(walker).weights.items()})
    expert = expert_actor(walker)
    found = best_teacher(walker, [still, expert], own_record(walker))
    assert found.teacher is expert
    assert 0.9 < found.share < 1.1


def test_a_drawn_variant_is_taught_only_with_a_good_teacher(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    good, mine = drawn_variant("hopper", 1), Variant.parse("hopper-massinc_37_torsogeom")
    # A new expert is in the folder that --output names.
    record = dict(own_record(BASE)) | {"variant": str(mine), "weights_sha256": silent().sha256}
    write_json(tmp_path / f"{mine}.json", record)
    save_arrays(tmp_path / f"{mine}.safetensors", silent().weights)

    def known(variant: Variant, candidates: list[Actor], expert: dict[str, Any]) -> Lesson:
        assert len(candidates) >= 2
        assert (variant == mine) == (candidates[0].sha256 == silent().sha256)
        return Lesson(variant, candidates[0], 0.9 if variant == good else 0.3)

    monkeypatch.setattr(universal, "best_teacher", known)
    taught = [each.variant for each in universal.lessons("hopper", tmp_path, 0, None)]
    listed, targets = [BASE, *catalogue("hopper")], universal.measured_variants("hopper")
    assert not {good, mine} & set(targets)
    assert taught == [*targets, mine, *listed, good]


@pytest.mark.parametrize("robot", ["hopper", "halfcheetah", "walker2d", "ant"])
def test_drawn_variants_are_within_the_ranges_and_of_every_category(robot: str) -> None:
    ranges, seen = drawing_ranges(robot, unlisted=True), set()
    for seed in range(300):
        variant = drawn_variant(robot, seed)
        assert drawn_variant(robot, seed) == variant
        assert 1 <= len(variant.changes) <= 3
        for change in variant.changes:
            low, high = ranges[f"{change.category}/{change.body}"]
            assert low <= change.percent <= high
            seen.add(change.category)
    assert seen == {name.partition("/")[0] for name in ranges}
    if robot != "ant":
        assert seen == set(CATEGORIES)


def test_the_critics_of_the_base_ignore_the_context_at_first() -> None:
    path = agent_file(BASE)
    assert path is not None
    base = load_arrays(path)
    contexts = np.array([[0.0, 0.5], [1.0, 0.5]], np.float32)
    kernel = "qf/params/VmapCritic_0/Dense_0/kernel"
    arrays = with_context(base, contexts, "hopper")
    assert np.array_equal(np.delete(arrays[kernel], [11, 12], axis=1), base[kernel])
    assert not arrays[kernel][:, 11:13].any()
    assert arrays["qf/batch_stats/VmapCritic_0/BatchRenorm_0/mean"][0, 11:13].tolist() == [0.5, 0.5]
    assert (arrays["qf/params/VmapCritic_0/BatchRenorm_0/scale"][:, 11:13] == 1).all()


def test_a_universal_policy_is_trained_killed_resumed_and_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(universal, "lessons", lambda *_: [lesson(BASE), lesson(HEAVY)])
    monkeypatch.setattr(universal, "catalogue", lambda robot: (HEAVY,))
    monkeypatch.setattr(universal, "Distilling", lambda seed: replace(QUICK, seed=seed))
    names = ("episodes", "return_mean", "return_std", "return_min", "return_max", "length_mean")
    returns = dict.fromkeys(names, 1e6)

    def measured(variant: Variant, policy: Actor) -> dict[str, Any]:
        return {"sha256": policy.sha256, "evaluation": dict(returns)}

    monkeypatch.setattr(universal, "evaluations", measured)
    changes = {
        "lanes": 10,
        "steps_per_call": 10,
        "max_steps": 400,
        "critic_updates": 18,
        "batch_size": 32,
        "buffer_size": 2000,
        "exploration_steps": 100,
        "evaluate_every": 150,
        "choosing_episodes": 1,
        "deciding_episodes": 1,
    }
    plan = Plan(tmp_path / "state", tmp_path / "policies", improve=True, changes=changes)
    lines: list[str] = []
    steps: list[int] = []

    def tell(progress: Progress, task: Task) -> None:
        steps.append(progress.steps)

    def die(progress: Progress, task: Task) -> None:
        if progress.steps == 250:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_universal("hopper", plan, lines.append, die)
    assert not (tmp_path / "policies").exists()
    assert lines == []
    # It goes on where it was: 150 steps are left.
    outcome = train_universal("hopper", plan, lines.append, tell)
    assert outcome.created
    assert steps == [400]
    assert any(line.startswith("round 2") for line in lines)
    # It ends in the weights of a run that was not killed.
    whole = Plan(tmp_path / "whole", tmp_path / "others", improve=True, changes=changes)
    assert train_universal("hopper", whole).record["weights_sha256"] == outcome.record["weights_sha256"]
    found = universal_policy("hopper", tmp_path / "policies")
    assert found is not None
    assert found.sha256 == outcome.record["weights_sha256"]
    assert outcome.record["measured"][str(HEAVY)]["sha256"] == found.fold(HEAVY).sha256
    assert found.actor.weights[FIRST_WEIGHT].shape[1] == 11 + len(found.low)
    assert not (tmp_path / "state" / "hopper-universal").exists()
    # Experts that are trained from it get its critics, and so does a later run.
    agent = tmp_path / "policies" / "hopper-universal.agent.safetensors"
    assert agent.stat().st_size < 1_000_000
    monkeypatch.setattr(starts, "EPISODES", 1)
    monkeypatch.setattr(starts, "catalogue", lambda robot: (HEAVY,))
    start = best_start(HEAVY, tmp_path / "policies", 0)
    assert start.agent["qf/params/VmapCritic_0/Dense_0/kernel"].shape[1] == 14
    kept = train_universal("hopper", Plan(tmp_path / "state", tmp_path / "policies"))
    assert (kept.created, kept.tried) == (False, {})
    # One that is not better is not installed.
    returns.update(return_mean=returns["return_mean"] - 1)
    untrained = replace(plan, changes=changes | {"max_steps": 0})
    again = train_universal("hopper", replace(untrained, seed=1))
    assert (again.created, bool(again.tried)) == (False, True)
    assert again.record["weights_sha256"] == found.sha256 != again.tried["weights_sha256"]
    # Without training steps, the known policies are distilled only, and the critics stay.
    returns.update(return_mean=returns["return_mean"] + 9)
    critics, steps[:] = agent.read_bytes(), []
    unfinished = tmp_path / "state" / "hopper-universal" / "run" / "checkpoint.safetensors"
    unfinished.parent.mkdir(parents=True)
    unfinished.touch()
    distilled = train_universal("hopper", replace(untrained, seed=2), on_interval=tell)
    assert (distilled.created, distilled.record["steps_trained"], steps) == (True, 0, [])
    assert distilled.record["weights_sha256"] != found.sha256
    assert agent.read_bytes() == critics
    assert unfinished.exists()
