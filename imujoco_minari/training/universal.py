"""Trains the universal policy of a robot: chooses teachers, distils them, trains the result further.

The loop repeats: with ``improve``, the present universal policy is one of the teachers and the start. Its
nearest relative is Generalist-Specialist Learning (Jia et al. 2022).
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.errors import PolicyNotFoundError, VariantError
from imujoco_minari.policies import (
    Actor,
    Array,
    agent_file,
    expert_actor,
    expert_variants,
    own_record,
    universal_policy,
)
from imujoco_minari.policies.references import evaluations
from imujoco_minari.policies.rungs import mean_return
from imujoco_minari.policies.universal import UniversalPolicy, universal_name, whole_context
from imujoco_minari.storage.files import write_json
from imujoco_minari.training.agents import ALGORITHM, load_arrays, save_arrays
from imujoco_minari.training.anchored import Anchored, AnchoredRun
from imujoco_minari.training.distilling import Distilling, Lesson, Round, best_teacher, distil
from imujoco_minari.training.plan import Plan
from imujoco_minari.training.sweep import Trained, lock_folder
from imujoco_minari.variants import Change, Variant, catalogue
from imujoco_minari.variants.context import parameters
from imujoco_minari.variants.off_dynamics import off_dynamics, off_dynamics_names
from imujoco_minari.variants.ranges import drawing_ranges

# Drawn variants that are distilled beside the listed ones, and the least share of their teachers.
DRAWN, WORTH_TEACHING = 80, 0.5
# Experts of other variants that are tried as teachers of a drawn one, beside those of its own parameters.
_OTHERS = 8


@dataclass(frozen=True)
class UniversalSettings:
    """The settings of a universal policy's training.

    Attributes:
        distilling: those of the distillation.
        anchored: those of the training after it; None to end with the distilled policy.
    """

    distilling: Distilling = field(default_factory=Distilling)
    anchored: Anchored | None = field(default_factory=Anchored)


def drawn_variant(robot: str, seed: int) -> Variant:
    """Return a variant for training: one to three changes of listed categories, or one of any other.

    The percents are drawn evenly from :func:`~imujoco_minari.variants.ranges.drawing_ranges`.
    """
    rng = np.random.default_rng(seed)
    listed, ranges = drawing_ranges(robot), drawing_ranges(robot, unlisted=True)
    categories = sorted({name.partition("/")[0] for name in ranges if name not in listed})
    while True:
        count, names = int(rng.choice([0, 1, 2, 3], p=[0.15, 0.4, 0.35, 0.1])), list(listed)
        if categories and (count == 0 or not listed):
            category = categories[int(rng.integers(len(categories)))]
            count, names = 1, [name for name in ranges if name.startswith(f"{category}/")]
        chosen = rng.choice(len(names), size=min(max(1, count), len(names)), replace=False)
        changes = []
        for name in (names[index] for index in chosen):
            category, _, body = name.partition("/")
            low, high = ranges[name]
            changes.append(Change(category, int(rng.integers(int(low), int(high) + 1)), body))
        try:
            return Variant(robot, tuple(changes))
        except VariantError:
            # Two changes of one part of the model.
            continue


def lessons(robot: str, policies: Path, seed: int) -> list[Lesson]:
    """Return variants of a robot with the best known policy of each.

    They are the base, the listed variants, all others that have an expert, and drawn ones. A drawn variant
    without a good teacher is left out.

    Args:
        robot: the robot.
        policies: folder to search before the package's.
        seed: of the drawn variants.

    Raises:
        PolicyNotFoundError: if the base has no expert.
    """
    base = Variant(robot)
    if not own_record(base, policies):
        raise PolicyNotFoundError(f"{base} has no expert to begin with: run `imujoco train {base}` first")
    base_return = mean_return(own_record(base, policies))
    own = {variant: expert_actor(variant) for variant in expert_variants(policies) if variant.robot == robot}
    present = universal_policy(robot, policies)
    known = dict.fromkeys([base, *catalogue(robot), *own])
    found = []
    for variant in known:
        candidates = {str(each): own[each] for each in (variant, base) if each in own}
        found.append(best_teacher(variant, candidates | _folded(present, variant), base_return))
    rng = np.random.default_rng(seed)
    for number in range(DRAWN):
        variant = drawn_variant(robot, seed=seed + number)
        changed = {(change.category, change.body) for change in variant.changes}
        near = [each for each in own if {(c.category, c.body) for c in each.changes} & changed]
        others = [each for each in own if each not in (*near, base)]
        tried = [others[index] for index in rng.permutation(len(others))[:_OTHERS]]
        candidates = {str(each): own[each] for each in (base, *near, *tried)}
        lesson = best_teacher(variant, candidates | _folded(present, variant), base_return)
        if lesson.share >= WORTH_TEACHING:
            found.append(lesson)
    return found


def _folded(present: UniversalPolicy | None, variant: Variant) -> dict[str, Actor]:
    return {} if present is None else {present.sha256[:12]: present.fold(variant)}


def train_universal(
    robot: str, plan: Plan, settings: UniversalSettings, say: Callable[[str], None] | None = None
) -> Trained:
    """Train the universal policy of a robot and install it. A killed run continues where it stopped.

    Args:
        robot: the robot.
        plan: the folders, and whether to improve a universal policy that exists.
        settings: the settings.
        say: called with a line about the progress now and then.

    Raises:
        PolicyNotFoundError: if the base has no expert, or no agent whose critics the training needs.
        TrainingError: if another process trains it.
    """
    say = say or do_nothing
    name = universal_name(robot)
    present = universal_policy(robot, plan.policies)
    if present is not None and not plan.improve:
        return Trained(name, dict(present.record))
    folder, begin = plan.state / name, time.monotonic()
    with lock_folder(folder):
        distilled = folder / "distilled.safetensors"
        if not distilled.is_file():
            say(f"choosing teachers for {robot}")
            taught = lessons(robot, plan.policies, plan.seed)
            shares = [lesson.share for lesson in taught]
            say(f"{len(taught)} variants, their teachers at {np.median(shares):.3f} of the base (median)")
            start = present.actor if present is not None else expert_actor(Variant(robot))
            weights = distil(taught, start, settings.distilling, partial(_tell, say))
            _write_ranges(folder, robot, taught)
            save_arrays(distilled, weights)
        weights = load_arrays(distilled)
        if settings.anchored is not None:
            weights, critics = _train_on(robot, plan, settings.anchored, weights, folder / "anchored", say)
            save_arrays(plan.policies / f"{name}.agent.safetensors", critics)
        record = _record(robot, weights, folder, plan, settings, time.monotonic() - begin)
        save_arrays(plan.policies / f"{name}.safetensors", weights)
        # The record is written last. Its presence means that the policy is complete.
        write_json(plan.policies / f"{name}.json", record)
        shutil.rmtree(folder)
    return Trained(name, record, created=True)


def do_nothing(line: str) -> None:
    """Do nothing with a line about the progress."""


def _tell(say: Callable[[str], None], told: Round, weights: dict[str, Array]) -> None:
    say(
        f"round {told.number}: {np.median(told.shares):.3f} of the teachers (median), "
        f"lowest {told.shares.min():.3f}, {told.seconds / 60:.1f} min"
    )


def _train_on(
    robot: str,
    plan: Plan,
    settings: Anchored,
    start: dict[str, Array],
    folder: Path,
    say: Callable[[str], None],
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Train a universal policy further; return the weights of the best checkpoint, and the critics."""
    base = Variant(robot)
    agent = agent_file(universal_name(robot), plan.policies) or agent_file(base, plan.policies)
    if agent is None:
        raise PolicyNotFoundError(f"the critics begin as those of {base}, which has no agent")
    base_return = mean_return(own_record(base, plan.policies))
    run = AnchoredRun(
        dict.fromkeys((base, *catalogue(robot)), base_return),
        partial(drawn_variant, robot),
        start,
        load_arrays(agent),
        settings,
        folder,
    )

    def tell(told: dict[str, Any]) -> None:
        say(
            f"{told['steps']:>9,} steps: {told['present']['median']:.3f} of the base (median), "
            f"lowest {told['present']['min']:.3f}; averaged {told['average']['median']:.3f}, "
            f"{told['average']['min']:.3f}; {told['seconds'] / 60:.1f} min"
        )

    run.train(tell)
    return load_arrays(folder / "best.safetensors"), run.critics()


def _write_ranges(folder: Path, robot: str, taught: Sequence[Lesson]) -> None:
    """Keep the ranges of the contexts that were taught, and the number of teachers by kind."""
    contexts = 100 * np.array([whole_context(lesson.variant) for lesson in taught])
    drawn = drawing_ranges(robot, unlisted=True)
    ranges = {
        name: [min(low, *drawn.get(name, (0, 0))), max(high, *drawn.get(name, (0, 0)))]
        for name, low, high in zip(
            parameters(robot), contexts.min(0).tolist(), contexts.max(0).tolist(), strict=True
        )
    }
    write_json(folder / "ranges.json", {name: [round(x, 2) for x in pair] for name, pair in ranges.items()})


def _record(
    robot: str,
    weights: dict[str, Array],
    folder: Path,
    plan: Plan,
    settings: UniversalSettings,
    seconds: float,
) -> dict[str, Any]:
    """Return the record of a universal policy, with its evaluations in the variants that the docs list."""
    ranges = json.loads((folder / "ranges.json").read_text("utf-8"))
    low, high = (np.array([ranges[name][side] for name in parameters(robot)]) / 100 for side in (0, 1))
    floats = {name: array.astype(np.float32) for name, array in weights.items()}
    policy = UniversalPolicy(robot, Actor(floats, ALGORITHM), low, high, {})
    return {
        "robot": robot,
        "algorithm": ALGORITHM,
        "weights_sha256": policy.sha256,
        "ranges": ranges,
        "seed": plan.seed,
        "distilling": vars(settings.distilling),
        "anchored": None if settings.anchored is None else vars(settings.anchored),
        "wall_seconds": round(seconds, 1),
        "versions": {name: version(name) for name in ("mujoco", "gymnasium", "jax", "sbx-rl", "numpy")},
        "measured": {
            str(variant): evaluations(variant, policy.fold(variant)) for variant in measured_variants(robot)
        },
    }


def measured_variants(robot: str) -> list[Variant]:
    """Return the variants in which a universal policy is evaluated: base, catalogue, targets of ODRL."""
    targets = [off_dynamics(name).target for name in off_dynamics_names(robot)]
    return list(dict.fromkeys([Variant(robot), *catalogue(robot), *targets]))
