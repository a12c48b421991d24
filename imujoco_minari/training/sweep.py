"""Many variants, one after another or side by side: resumed where it was, never a finished one again.

The state folder holds one folder a variant. A variant is finished when its policy and record lie in
the policies folder; a lock in its state folder keeps two sweeps from training it at once.
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

# A variant's run ends when its actor is as good as this share of the base expert's return.
TARGET_SHARE = 0.98
# A start that has this share of what is asked needs smaller steps, not more.
NEAR_SHARE = 0.9
# One that has less than this share goes by way of milder variants.
FAR_SHARE = 0.5


@dataclass(frozen=True)
class Plan:
    """How a sweep trains, whatever the variant.

    Attributes:
        state: the folder that holds the unfinished runs.
        policies: where finished policies go; None for the user's own folder.
        scratch: train from scratch, also variants.
        seed: of all that is random.
        target: return (mean less deviation) to stop at; None for a share of the base expert's.
        changes: hyperparameters that differ from the file's.
        nice: lower the priority of the process by this much.
        improve: train finished policies on, and keep what is better.
        device: where the updates are computed: ``cpu``, ``gpu``, or None for the best that JAX has.
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
    """What became of one variant or generalist.

    Attributes:
        variant: the variant, or the generalist's name.
        record: of the policy that is there now.
        created: whether that was made now.
        tried: record of a run that was to improve it and did not.
        error: why it failed.
        missing: whether it failed because something that was asked for does not exist.
    """

    variant: Variant | str
    record: dict[str, Any] = field(default_factory=dict)
    created: bool = False
    tried: dict[str, Any] = field(default_factory=dict)
    error: str = ""
    missing: bool = False


def train(variant: Variant, plan: Plan, on_interval: OnInterval | None = None) -> Trained:
    """Train one variant, or take up its training where it was, and put its policy in place.

    Args:
        variant: any variant of the grammar.
        plan: how.
        on_interval: called with the run's progress and hyperparameters after every evaluation.

    Raises:
        ImujocoError: when the base agent to start from is not there, or another process is at it.
    """
    if not plan.improve and (done := expert_record(variant, plan.policies)):
        return Trained(variant, dict(done))
    folder = plan.state / str(variant)
    with _locked(folder):
        # Looked up again: another process may have finished it while this one waited for nothing.
        done = expert_record(variant, plan.policies)
        if done and not plan.improve:
            return Trained(variant, dict(done))
        record = _run(task(variant, plan), folder, plan, on_interval)
        better = not done or _score(record) > _score(done)
        if better:
            before = {"before": {key: done.get(key) for key in _HISTORY}} if done else {}
            record = install(folder, record | before, plan.policies)
        # The replay buffer alone is tens of megabytes.
        shutil.rmtree(folder)
    if better:
        return Trained(variant, record, created=True)
    return Trained(variant, dict(done), tried=record)


def _run(work: Task, folder: Path, plan: Plan, on_interval: OnInterval | None = None) -> dict[str, Any]:
    """Run a task, or the rest of it, to its end and return the record of its best actor."""
    run = Run(work, folder, device=plan.device)
    try:
        return run.train(on_interval)
    finally:
        run.close()


def train_generalist(robot: str, plan: Plan) -> Trained:
    """Train one agent over the base and all variants of a robot, for the variants to start from.

    Raises:
        ImujocoError: when the base agent to start from is not there, or another process is at it.
    """
    name = generalist_name(robot)
    folder, target = plan.state / name, policies_folder() if plan.policies is None else plan.policies
    with _locked(folder):
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
        record = _run(whole, folder, plan) | {"variant": name}
        target.mkdir(parents=True, exist_ok=True)
        write_json(target / f"{name}.agent.json", record)
        # The agent comes last: it says that the generalist is there.
        save_arrays(target / f"{name}.agent.safetensors", load_arrays(folder / "best-agent.safetensors"))
        shutil.rmtree(folder)
    return Trained(name, record, created=True)


def train_all(
    variants: Sequence[Variant], plan: Plan, *, jobs: int = 1, backend: str | None = None
) -> Iterator[Trained]:
    """Train many variants and yield each outcome as it comes, failures included.

    Bases come first, since the others start from them; then, for robots all of whose variants are to be
    trained, the generalists. A run that is lost with its worker goes on from
    its last checkpoint; for ``backend`` see :func:`imujoco_minari.parallel.run_jobs`.
    """
    for group in _in_order(variants, plan):
        apart = backend is not None or (jobs > 1 and len(group) > 1)
        work = partial(_attempt, plan=plan)
        outcomes = run_jobs(work, group, jobs=jobs if apart else 1, backend=backend)
        for number, outcome in outcomes:
            yield Trained(group[number], error=str(outcome)) if isinstance(outcome, JobError) else outcome


def install(folder: Path, record: dict[str, Any], policies: Path | None) -> dict[str, Any]:
    """Put the policy of a finished run where policies are looked for, and return its completed record.

    With a base go its whole agent, which its variants start from, and the rungs of its ladder.
    """
    target = policies_folder() if policies is None else policies
    target.mkdir(parents=True, exist_ok=True)
    variant, expert = Variant.parse(record["variant"]), record["evaluation"]["return_mean"]
    # An improved base keeps the ladder of its way up; an expert's further training falls as it likes.
    rungs = rungs_of(variant.base, policies)
    if variant.category == BASE:
        if "before" not in record:
            evaluations = load_progress(folder).evaluations
            rungs = keep_rungs(folder / "ladder", evaluations, expert, variant, target)
        save_arrays(target / f"{variant}.agent.safetensors", load_arrays(folder / "best-agent.safetensors"))
    record = record | {"ladder": measure_ladder(variant, expert, rungs, target)}
    save_arrays(target / f"{variant}.safetensors", load_arrays(folder / "best.safetensors"))
    # The record comes last: it says that the policy is there.
    write_json(target / f"{variant}.json", record)
    return record


# What a record says of the policy that its own improves on.
_HISTORY = (
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


def _score(record: Mapping[str, Any]) -> float:
    return float(record["evaluation"]["return_mean"] - record["evaluation"]["return_std"])


def _attempt(variant: Variant | str, plan: Plan) -> Trained:
    """Train a variant, or the generalist of a robot that is given by its name."""
    # Processes of a pool are used again, and must not sink deeper with every variant.
    os.nice(max(0, plan.nice - max(0, os.nice(0))))
    try:
        return train(variant, plan) if isinstance(variant, Variant) else train_generalist(variant, plan)
    except ImujocoError as error:
        return Trained(variant, error=str(error), missing=isinstance(error, NotFoundError))


def task(variant: Variant, plan: Plan) -> Task:
    """Return what the plan makes of a variant: start, target and hyperparameters.

    Raises:
        PolicyNotFoundError: when the agent to start from is not there.
    """
    record = expert_record(variant.base, plan.policies)
    target = float("inf") if plan.target is None else plan.target
    improving = plan.improve and bool(expert_record(variant, plan.policies))
    if plan.scratch or (variant.category == BASE and not improving):
        settings = hyperparameters(variant.robot, SCRATCH, **plan.changes)
        return Task(variant, settings, plan.seed, target=target)
    start = best_start(variant, plan.policies)
    asked = TARGET_SHARE * _score(record)
    if plan.target is None and not improving:
        target = asked
    kind = IMPROVE if variant.category == BASE else _kind(start.score / asked)
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


def _kind(share: float) -> str:
    """Return what kind of start one is that has this share of what is asked."""
    if share >= NEAR_SHARE:
        return NEAR
    return WARM if share >= FAR_SHARE else FAR


def _in_order(variants: Sequence[Variant], plan: Plan) -> Iterator[list[Variant | str]]:
    """Yield what must be done before what follows: bases, the names of robots for generalists, the rest."""
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
def _locked(folder: Path) -> Iterator[None]:
    """Hold a run's state folder against other processes."""
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
    """Return where unfinished runs lie unless told otherwise: beside the user's policies."""
    return policies_folder().parent / "training"
