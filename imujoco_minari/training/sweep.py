"""Training of many variants, in sequence or in parallel. A sweep resumes runs and skips finished variants.

The state folder has one folder per variant. A variant is finished when its policy and record are in the
policies folder. A lock in its state folder prevents two sweeps from training it at once.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from imujoco_minari.errors import ImujocoError, JobError, StorageError, TrainingError
from imujoco_minari.parallel import run_jobs
from imujoco_minari.policies import expert_record, own_record
from imujoco_minari.policies.rungs import return_at
from imujoco_minari.storage.files import try_lock, write_json
from imujoco_minari.training.hyperparameters import IMPROVE, NEAR, SCRATCH, WARM, hyperparameters
from imujoco_minari.training.installing import install, present_scores
from imujoco_minari.training.run import OnInterval, Run, do_nothing
from imujoco_minari.training.starts import best_start
from imujoco_minari.training.task import Plan, Task
from imujoco_minari.variants import BASE, Variant

# A variant's run ends when its actor's score reaches this share of the base expert's mean return. The score
# counts the lowest return too, so it is a few percent below the mean.
TARGET_SHARE = 0.96
# A start with at least this share of the target trains at a smaller learning rate.
NEAR_SHARE = 0.9


@dataclass(frozen=True)
class Trained:
    """The outcome of training one variant or universal policy.

    Attributes:
        variant: the variant, or the universal policy's name.
        record: record of the present policy.
        created: whether this call trained that policy.
        tried: record of a run that gave no better policy, with its ``score`` and the ``kept_score``.
        error: why the training failed; empty on success.
        missing: whether it failed because something that was asked for does not exist.
    """

    variant: Variant | str
    record: dict[str, Any] = field(default_factory=dict)
    created: bool = False
    tried: dict[str, Any] = field(default_factory=dict)
    error: str = ""
    missing: bool = False


def train(
    variant: Variant,
    plan: Plan,
    on_interval: OnInterval = do_nothing,
    say: Callable[[str], None] = lambda line: None,
) -> Trained:
    """Train one variant, or resume its training, and install its policy if it is the best one.

    The expert of a variant is the better of its own and the folded one. If the folded one stays the expert,
    the state folder keeps the record of the run, and the run is not repeated without ``improve``.

    Args:
        variant: any variant of the grammar.
        plan: the settings.
        on_interval: called with the progress and the task of a run after every interval.
        say: called with a line before long work.

    Raises:
        PolicyNotFoundError: if the agent to start from does not exist.
        TrainingError: if another process trains the variant.
    """
    if not plan.improve and (done := own_record(variant, plan.policies)):
        return Trained(variant, dict(done))
    folder = plan.state / str(variant)
    with lock_folder(folder):
        # Another process may have finished it before this one got the lock.
        done = dict(own_record(variant, plan.policies))
        if done and not plan.improve:
            return Trained(variant, done)
        present = done or dict(expert_record(variant, plan.policies))
        beaten = folder / "tried.json"
        if beaten.is_file() and not plan.improve:
            tried = json.loads(beaten.read_text("utf-8"))
            if tried["not_better_than"] == present.get("weights_sha256"):
                return Trained(variant, present, tried=tried)
        with closing(Run(task(variant, plan, say), folder, device=plan.device)) as run:
            run.train(on_interval)
            record, reached = run.make_record(), run.progress.best_score
        # The episodes of the records' evaluations select nothing, so those of the selection compare.
        kept_score = max(present_scores(variant, plan.policies, record["selection"]["episodes"]))
        better = reached > kept_score
        # A start that was told this variant and not trained further is the folded policy itself.
        if better and not (record["start_told"] == str(variant) and record["steps"] == 0):
            installed = install(run, record, plan.policies)
            outcome = Trained(variant, installed, created=True)
        else:
            outcome = Trained(variant, present, tried=record | {"score": reached, "kept_score": kept_score})
        # The replay buffer alone is tens of megabytes.
        shutil.rmtree(folder)
        if not outcome.created and not done:
            write_json(beaten, outcome.tried | {"not_better_than": present["weights_sha256"]})
    return outcome


def train_all(
    variants: Sequence[Variant], plan: Plan, *, jobs: int = 1, backend: str | None = None
) -> Iterator[Trained]:
    """Train many variants and yield each outcome when it is ready, failures included.

    Bases are trained first, because variants start from them. A run that is lost with its worker resumes
    from its last checkpoint.

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


def _train_or_report(variant: Variant, plan: Plan) -> Trained:
    """Train a variant; return errors as an outcome."""
    # A process of a pool trains several variants. Set its nice value once, do not add to it each time.
    os.nice(max(0, plan.nice - max(0, os.nice(0))))
    try:
        return train(variant, plan)
    except ImujocoError as error:
        return Trained(variant, error=str(error), missing=error.missing)


def task(variant: Variant, plan: Plan, say: Callable[[str], None] = lambda line: None) -> Task:
    """Return the run of a variant under a plan: its start, target and hyperparameters."""
    target = float("inf") if plan.target is None else plan.target
    improving = plan.improve and bool(own_record(variant, plan.policies))
    if plan.scratch or (variant.category == BASE and not improving):
        settings = hyperparameters(variant.robot, SCRATCH, **plan.changes)
        return Task(variant, settings, plan.seed, target=target)
    generations = hyperparameters(variant.robot, WARM, **plan.changes).search_generations
    start = best_start(variant, plan.policies, generations, say)
    base = own_record(variant.base, plan.policies)
    needed_score = return_at(TARGET_SHARE, base)
    if plan.target is None and not plan.improve:
        target = needed_score
    near = start.score >= return_at(NEAR_SHARE * TARGET_SHARE, base)
    kind = IMPROVE if variant.category == BASE else NEAR if near else WARM
    settings = hyperparameters(variant.robot, kind, **plan.changes)
    return Task(variant, settings, plan.seed, start, target)


def _training_groups(variants: Sequence[Variant], plan: Plan) -> Iterator[list[Variant]]:
    """Yield groups in order of training: bases, also those that others start from, then other variants."""
    first = [variant for variant in variants if variant.category == BASE]
    rest = [variant for variant in variants if variant.category != BASE]
    if not plan.scratch:
        needed = dict.fromkeys(variant.base for variant in rest)
        first += [base for base in needed if base not in first and not own_record(base, plan.policies)]
    yield from (group for group in (first, rest) if group)


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock a run's state folder.

    Raises:
        StorageError: if the folder cannot be written.
        TrainingError: if another process has the lock.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder / "lock", os.O_CREAT | os.O_RDWR)
    except OSError as error:
        raise StorageError(f"cannot write {folder}: {error.strerror or error}") from None
    try:
        try:
            try_lock(handle)
        except BlockingIOError:
            raise TrainingError(f"{folder.name} is being trained by another process, in {folder}") from None
        yield
    finally:
        os.close(handle)
