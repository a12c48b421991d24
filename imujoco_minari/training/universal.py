"""Trains the universal policy of a robot: in many variants, then by distilling the best known policies.

Training gives a policy that is strong in some variants and weak in others. So it is only one of the teachers,
beside the experts and, with ``improve``, the present universal policy: each variant has the best of them. The
nearest relative is Generalist-Specialist Learning (Jia et al. 2022).
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.errors import PolicyNotFoundError, VariantError
from imujoco_minari.policies import agent_file, expert_actor, expert_variants, own_record, universal_policy
from imujoco_minari.policies.references import evaluations
from imujoco_minari.policies.universal import (
    UniversalPolicy,
    universal_name,
    universal_of_record,
    whole_context,
)
from imujoco_minari.storage.files import write_json
from imujoco_minari.training.agents import (
    ALGORITHM,
    CRITICS,
    agent_actor,
    load_arrays,
    replace_actor,
    save_arrays,
)
from imujoco_minari.training.context_search import best_told
from imujoco_minari.training.critics import with_context
from imujoco_minari.training.distilling import Distilling, Lesson, best_teacher, distil
from imujoco_minari.training.hyperparameters import UNIVERSAL, hyperparameters
from imujoco_minari.training.run import OnInterval, Progress, Run, do_nothing, versions
from imujoco_minari.training.selection import score, universal_of
from imujoco_minari.training.sweep import Trained, lock_folder
from imujoco_minari.training.task import Distribution, Plan, Start, Task
from imujoco_minari.variants import Change, Variant, catalogue
from imujoco_minari.variants.context import parameters
from imujoco_minari.variants.off_dynamics import off_dynamics, off_dynamics_names
from imujoco_minari.variants.ranges import drawing_ranges

# Drawn variants that are distilled beside the listed ones, and the least share of the teacher of one.
# With fewer, the student became worse in variants that it had not seen: docs/design.md.
DRAWN, WORTH_TEACHING = 240, 0.4
# Experts of variants with a change of the same parameter that are tried as teachers of a drawn one.
_NEAR = 4


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


def lessons(robot: str, policies: Path, seed: int, trained: UniversalPolicy | None) -> list[Lesson]:
    """Return variants of a robot with the best known policy of each.

    They are the base, the listed variants, ODRL's targets, all others that have an expert, and drawn ones. A
    drawn variant is left out if no policy reaches two fifths of the base expert's return. The base and the
    listed ones are returned twice, because most of the others are drawn. The universal policy ``trained``
    may teach too, also while it is told another variant.
    """
    base = Variant(robot)
    expert = own_record(base, policies)
    experts = (variant for variant in expert_variants(policies) if variant.robot == robot)
    own = {variant: expert_actor(variant, folder=policies) for variant in experts}
    present = universal_policy(robot, policies)
    listed = [base, *catalogue(robot)]
    found = []
    for variant in dict.fromkeys([*measured_variants(robot), *own]):
        candidates = [own[each] for each in dict.fromkeys([variant, base]) if each in own]
        candidates += [present.fold(variant)] if present else []
        if trained:
            candidates += map(trained.fold, dict.fromkeys([variant, *best_told(trained, variant, listed)]))
        found.append(best_teacher(variant, candidates, expert))
    found += [lesson for lesson in found if lesson.variant in listed]
    rng = np.random.default_rng(seed)
    for number in range(DRAWN):
        variant = drawn_variant(robot, seed=seed + number)
        changed = {(change.category, change.body) for change in variant.changes}
        near = [each for each in own if {(c.category, c.body) for c in each.changes} & changed]
        tried = [near[index] for index in rng.permutation(len(near))[:_NEAR]]
        candidates = [own[each] for each in (base, *tried)]
        candidates += [universal.fold(variant) for universal in (present, trained) if universal]
        lesson = best_teacher(variant, candidates, expert)
        if lesson.share >= WORTH_TEACHING:
            found.append(lesson)
    return found


def train_universal(
    robot: str,
    plan: Plan,
    say: Callable[[str], None] = lambda line: None,
    on_interval: OnInterval = do_nothing,
) -> Trained:
    """Train the universal policy of a robot and install it, unless the present one is better.

    A killed run continues where it stopped. Without training steps, the known policies are distilled only.

    Args:
        robot: the robot.
        plan: the folders, the hyperparameters that differ, and whether to improve a policy that exists.
        say: called with a line about the distillation now and then.
        on_interval: called with the progress and the task after every interval of the training before it.

    Raises:
        PolicyNotFoundError: if the base has no expert, or no agent that the training begins as.
        TrainingError: if another process trains it.
    """
    name, present = universal_name(robot), universal_policy(robot, plan.policies)
    if present is not None and not plan.improve:
        return Trained(name, dict(present.record))
    distilling, folder = Distilling(seed=plan.seed), plan.state / name
    with lock_folder(folder):
        task = _task(robot, plan)
        progress, agent, trained = Progress(), task.start.agent, None
        if task.settings.max_steps:
            with closing(Run(task, folder / "run", device=plan.device)) as run:
                run.train(on_interval)
            progress, agent = run.progress, run.best_agent()
            trained = universal_of(agent_actor(agent), robot)
        begin = time.monotonic()
        say(f"choosing teachers for {robot}")
        taught = lessons(robot, plan.policies, plan.seed, trained)
        shares = [lesson.share for lesson in taught]
        say(f"{len(taught)} variants, their teachers at {np.median(shares):.3f} of the base (median)")
        start = present or trained or universal_of(agent_actor(agent), robot)
        weights = distil(taught, start.actor, distilling, say)
        record: dict[str, Any] = {
            "robot": robot,
            "algorithm": ALGORITHM,
            "weights_sha256": universal_of(weights, robot).sha256,
            "ranges": _ranges(robot, taught),
            "seed": plan.seed,
            "distilling": vars(distilling),
            "hyperparameters": task.settings.asdict(),
            "steps": progress.best_steps,
            "steps_trained": progress.steps,
            "updates": progress.updates,
            "wall_seconds": round(progress.wall_seconds + time.monotonic() - begin, 1),
            "versions": versions(),
            "measured": {},
        }
        policy = universal_of_record(universal_of(weights, robot).actor, record)
        for variant in measured_variants(robot):
            record["measured"][str(variant)] = evaluations(variant, policy.fold(variant))
        if present is not None and _score(present.record) >= _score(record):
            outcome = Trained(name, dict(present.record), tried=record)
        else:
            save_arrays(plan.policies / f"{name}.safetensors", weights)
            if trained or not present:
                critics = {path: array for path, array in agent.items() if path.startswith(CRITICS)}
                save_arrays(plan.policies / f"{name}.agent.safetensors", critics)
            # The record is written last. Its presence means that the policy is complete.
            write_json(plan.policies / f"{name}.json", record)
            outcome = Trained(name, record, created=True)
        # Distilling alone leaves an unfinished training as it is.
        if trained or not (folder / "run").exists():
            shutil.rmtree(folder)
    return outcome


def _score(record: Mapping[str, Any]) -> float:
    """Return the mean score of a universal policy over the variants that it was evaluated in."""
    return float(np.mean([score(measured["evaluation"]) for measured in record["measured"].values()]))


def _task(robot: str, plan: Plan) -> Task:
    """Return the training in many variants, which begins as the base's agent."""
    base = Variant(robot)
    expert, path = own_record(base, plan.policies), agent_file(base, plan.policies)
    if not expert or path is None:
        raise PolicyNotFoundError(f"{base} has no agent to begin with: run `imujoco train {base}` first")
    listed = (base, *catalogue(robot))
    contexts = np.array([whole_context(variant) for variant in listed], np.float32)
    agent = load_arrays(path)
    as_shipped = replace_actor(agent, agent_actor(agent))
    return Task(
        base,
        hyperparameters(robot, UNIVERSAL, **plan.changes),
        plan.seed,
        Start(str(base), with_context(as_shipped, contexts, robot)),
        over=Distribution(listed, expert, partial(drawn_variant, robot)),
    )


def _ranges(robot: str, taught: Sequence[Lesson]) -> dict[str, list[float]]:
    """Return the lowest and the highest percent of each parameter that was taught or is drawn."""
    contexts = 100 * np.array([whole_context(lesson.variant) for lesson in taught])
    drawn, lowest, highest = drawing_ranges(robot, unlisted=True), contexts.min(0), contexts.max(0)
    ranges = {}
    for name, low, high in zip(parameters(robot), lowest.tolist(), highest.tolist(), strict=True):
        least, most = drawn.get(name, (0, 0))
        ranges[name] = [round(min(low, least), 2), round(max(high, most), 2)]
    return ranges


def measured_variants(robot: str) -> list[Variant]:
    """Return the variants in which a universal policy is evaluated: base, catalogue, targets of ODRL."""
    targets = [off_dynamics(name).target for name in off_dynamics_names(robot)]
    return list(dict.fromkeys([Variant(robot), *catalogue(robot), *targets]))
