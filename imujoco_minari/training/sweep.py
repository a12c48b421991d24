"""Training of many variants, in sequence or in parallel. A sweep resumes runs and skips finished variants.

The state folder has one folder per variant. A variant is finished when its policy and record are in the
policies folder. A lock in its state folder prevents two sweeps from training it at once.
"""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from imujoco_minari.errors import ImujocoError, JobError, NotFoundError, TrainingError
from imujoco_minari.parallel import run_jobs
from imujoco_minari.policies import expert_record, policies_folder
from imujoco_minari.storage.files import write_json
from imujoco_minari.training.agents import load_arrays, save_arrays
from imujoco_minari.training.hyperparameters import (
    FAR,
    GENERALIST,
    IMPROVE,
    NEAR,
    SCRATCH,
    WARM,
    hyperparameters,
)
from imujoco_minari.training.ladder import keep_rungs, measure_ladder, rungs_of
from imujoco_minari.training.run import OnInterval, Run, Task, load_progress
from imujoco_minari.training.starts import base_start, best_start, generalist_name, generalist_record
from imujoco_minari.variants import BASE, Variant, catalogue

# A variant's run ends when its actor reaches this share of the base expert's score.
TARGET_SHARE = 0.98
# A start with at least this share of the target trains at a smaller learning rate.
NEAR_SHARE = 0.9
# A start with less than this share of the target trains in milder variants first.
FAR_SHARE = 0.5


@dataclass(frozen=True)
class Plan:
    """The settings of a sweep, the same for every variant.

    Attributes:
        state: folder of the unfinished runs.
        policies: folder of finished policies; None for the user's folder.
        scratch: train variants from scratch too.
        seed: seed of all that is random.
        target: stop at this return (mean less deviation); None for a share of the base expert's.
        changes: hyperparameters that replace those of the file.
        nice: increase of the process's nice value.
        improve: continue the training of finished policies and keep the better ones.
        device: device of the updates: ``cpu``, ``gpu``, or None for JAX's default.
    """

    state: Path
    policies: Path | None = None
    scratch: bool = False
    seed: int = 0
    target: float | None = None
    changes: dict[str, Any] = field(default_factory=dict)
    nice: int = 0
    improve: bool = False
    device: str | None = None


@dataclass(frozen=True)
class Trained:
    """The outcome of training one variant or generalist.

    Attributes:
        variant: the variant, or the generalist's name.
        record: record of the present policy.
        created: whether this call trained that policy.
        tried: record of a run that did not improve the policy.
        error: why the training failed; empty on success.
        missing: whether it failed because something that was asked for does not exist.
    """

    variant: Variant | str
    record: dict[str, Any] = field(default_factory=dict)
    created: bool = False
    tried: dict[str, Any] = field(default_factory=dict)
    error: str = ""
    missing: bool = False


def train(variant: Variant, plan: Plan, on_interval: OnInterval | None = None) -> Trained:
    """Train one variant, or resume its training, and install its policy.

    Args:
        variant: any variant of the grammar.
        plan: the settings.
        on_interval: called with the run's progress and hyperparameters after every interval.

    Raises:
        PolicyNotFoundError: if the agent to start from does not exist.
        TrainingError: if another process trains the variant.
    """
    if not plan.improve and (done := expert_record(variant, plan.policies)):
        return Trained(variant, dict(done))
    folder = plan.state / str(variant)
    with _lock_folder(folder):
        # Another process may have finished it before this one got the lock.
        done = expert_record(variant, plan.policies)
        if done and not plan.improve:
            return Trained(variant, dict(done))
        record = _finish_run(task(variant, plan), folder, plan, on_interval)
        better = not done or _record_score(record) > _record_score(done)
        if better:
            before = {"before": {key: done.get(key) for key in _HISTORY_KEYS}} if done else {}
            record = install(folder, record | before, plan.policies)
        # The replay buffer alone is tens of megabytes.
        shutil.rmtree(folder)
    if better:
        return Trained(variant, record, created=True)
    return Trained(variant, dict(done), tried=record)


def _finish_run(
    work: Task, folder: Path, plan: Plan, on_interval: OnInterval | None = None
) -> dict[str, Any]:
    """Run or resume a task to its end and return the record of its best actor."""
    run = Run(work, folder, device=plan.device)
    try:
        return run.train(on_interval)
    finally:
        run.close()


def train_generalist(robot: str, plan: Plan) -> Trained:
    """Train one agent over the base and all variants of a robot. Variants may start from it.

    Args:
        robot: name of the robot.
        plan: the settings.

    Raises:
        PolicyNotFoundError: if the base's agent does not exist.
        TrainingError: if another process trains the generalist.
    """
    name = generalist_name(robot)
    folder, target = plan.state / name, policies_folder() if plan.policies is None else plan.policies
    with _lock_folder(folder):
        if done := generalist_record(robot, plan.policies):
            return Trained(name, done)
        base = Variant.parse(f"{robot}-{BASE}")
        start = base_start(base, plan.policies)
        whole = Task(
            base,
            hyperparameters(robot, GENERALIST, **plan.changes),
            plan.seed,
            start=start.name,
            agent=start.agent,
            start_sha256=start.sha256,
            among=(base, *catalogue(robot)),
        )
        record = _finish_run(whole, folder, plan) | {"variant": name}
        target.mkdir(parents=True, exist_ok=True)
        write_json(target / f"{name}.agent.json", record)
        # The agent is written last. Its presence means that the generalist is complete.
        save_arrays(target / f"{name}.agent.safetensors", load_arrays(folder / "best-agent.safetensors"))
        shutil.rmtree(folder)
    return Trained(name, record, created=True)


def train_all(
    variants: Sequence[Variant], plan: Plan, *, jobs: int = 1, backend: str | None = None
) -> Iterator[Trained]:
    """Train many variants and yield each outcome when it is ready, failures included.

    Bases are trained first, because variants start from them. The generalist follows for each robot whose
    variants are all to be trained. A run that is lost with its worker resumes from its last checkpoint.

    Args:
        variants: the variants.
        plan: the settings.
        jobs: number of processes.
        backend: see :func:`imujoco_minari.parallel.run_jobs`.

    Raises:
        JobError: if the back end cannot be used.
    """
    for group in _training_groups(variants, plan):
        apart = backend is not None or (jobs > 1 and len(group) > 1)
        work = partial(_train_or_report, plan=plan)
        outcomes = run_jobs(work, group, jobs=jobs if apart else 1, backend=backend)
        for number, outcome in outcomes:
            yield Trained(group[number], error=str(outcome)) if isinstance(outcome, JobError) else outcome


def install(folder: Path, record: dict[str, Any], policies: Path | None) -> dict[str, Any]:
    """Copy the policy of a finished run to the policies folder and return its complete record.

    For a base, its complete agent and the rungs of its ladder are copied too.

    Args:
        folder: state folder of the run.
        record: the run's record.
        policies: folder of finished policies; None for the user's folder.
    """
    target = policies_folder() if policies is None else policies
    target.mkdir(parents=True, exist_ok=True)
    variant, expert = Variant.parse(record["variant"]), record["evaluation"]["return_mean"]
    # An improved base keeps its first ladder: the returns of further training do not rise step by step.
    rungs = rungs_of(variant.base, policies)
    if variant.category == BASE:
        if "before" not in record:
            evaluations = load_progress(folder).evaluations
            rungs = keep_rungs(folder / "ladder", evaluations, expert, variant, target)
        save_arrays(target / f"{variant}.agent.safetensors", load_arrays(folder / "best-agent.safetensors"))
    record = record | {"ladder": measure_ladder(variant, expert, rungs, target)}
    save_arrays(target / f"{variant}.safetensors", load_arrays(folder / "best.safetensors"))
    # The record is written last. Its presence means that the policy is complete.
    write_json(target / f"{variant}.json", record)
    return record


# The entries of a record that are kept, under `before`, when the policy is improved.
_HISTORY_KEYS = (
    "start",
    "seed",
    "steps",
    "steps_trained",
    "updates",
    "wall_seconds",
    "weights_sha256",
    "evaluation",
    "before",
)


def _record_score(record: Mapping[str, Any]) -> float:
    return float(record["evaluation"]["return_mean"] - record["evaluation"]["return_std"])


def _train_or_report(variant: Variant | str, plan: Plan) -> Trained:
    """Train a variant, or the generalist of the robot with this name; return errors as an outcome."""
    # A process of a pool trains several variants. Set its nice value once, do not add to it each time.
    os.nice(max(0, plan.nice - max(0, os.nice(0))))
    try:
        return train(variant, plan) if isinstance(variant, Variant) else train_generalist(variant, plan)
    except ImujocoError as error:
        return Trained(variant, error=str(error), missing=isinstance(error, NotFoundError))


def task(variant: Variant, plan: Plan) -> Task:
    """Return the run of a variant under a plan: its start, target and hyperparameters.

    Raises:
        PolicyNotFoundError: if the agent to start from does not exist.
    """
    record = expert_record(variant.base, plan.policies)
    target = float("inf") if plan.target is None else plan.target
    improving = plan.improve and bool(expert_record(variant, plan.policies))
    if plan.scratch or (variant.category == BASE and not improving):
        settings = hyperparameters(variant.robot, SCRATCH, **plan.changes)
        return Task(variant, settings, plan.seed, target=target)
    start = best_start(variant, plan.policies)
    needed_score = TARGET_SHARE * _record_score(record)
    if plan.target is None and not improving:
        target = needed_score
    kind = IMPROVE if variant.category == BASE else _start_kind(start.score / needed_score)
    settings = hyperparameters(variant.robot, kind, **plan.changes)
    return Task(
        variant,
        settings,
        plan.seed,
        start=start.name,
        agent=start.agent,
        start_sha256=start.sha256,
        target=target,
    )


def _start_kind(share: float) -> str:
    """Return the kind of a start that reaches this share of the target."""
    if share >= NEAR_SHARE:
        return NEAR
    return WARM if share >= FAR_SHARE else FAR


def _training_groups(variants: Sequence[Variant], plan: Plan) -> Iterator[list[Variant | str]]:
    """Yield groups in order of training: bases, robots whose generalist is needed, other variants."""
    first = [variant for variant in variants if variant.category == BASE]
    rest = [variant for variant in variants if variant.category != BASE]
    general: list[str] = []
    if not plan.scratch:
        needed = dict.fromkeys(variant.base for variant in rest)
        first += [base for base in needed if base not in first and not expert_record(base, plan.policies)]
        general = [
            base.robot
            for base in needed
            if set(catalogue(base.robot)) <= set(rest) and not generalist_record(base.robot, plan.policies)
        ]
    groups: tuple[Sequence[Variant | str], ...] = (first, general, rest)
    yield from (list(group) for group in groups if group)


@contextmanager
def _lock_folder(folder: Path) -> Iterator[None]:
    """Lock a run's state folder; raise a TrainingError if another process has the lock."""
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder / "lock", os.O_CREAT | os.O_RDWR)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise TrainingError(f"{folder.name} is being trained by another process, in {folder}") from None
        yield
    finally:
        os.close(handle)


def default_state() -> Path:
    """Return the default folder of unfinished runs, beside the user's policies."""
    return policies_folder().parent / "training"
