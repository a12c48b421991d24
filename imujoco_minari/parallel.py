"""Independent jobs on the processes of this machine (joblib) or on a Ray cluster.

The system may kill a worker for its memory, and a machine may go down. Every job of this package
publishes, trains or verifies one thing and is safe to run twice. So a job that is lost with its worker
runs again, at most :data:`ATTEMPTS` times.
"""

from __future__ import annotations

import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from imujoco_minari.errors import JobError, missing_dependency, whole_number

Argument = TypeVar("Argument")
Result = TypeVar("Result")
# The number of a job, its result, and the exception that it raised.
_Outcome: TypeAlias = tuple[int, Any, Exception | None]

BACKENDS = ("loky", "ray")
ATTEMPTS = 3

# Seconds between two checks of a worker that its parent process is alive.
_CHECK_EVERY = 0.5

# These variables decide where files are read and written. Workers get the caller's values.
_PATHS = ("MINARI_DATASETS_PATH", "IMUJOCO_HOME")


def run_jobs(
    function: Callable[[Argument], Result],
    arguments: Sequence[Argument],
    *,
    jobs: int = 1,
    backend: str | None = None,
) -> Iterator[tuple[int, Result | JobError]]:
    """Call ``function`` with each argument; yield the argument's number and the result as they come.

    Args:
        function: picklable, and safe to run twice with one argument. Its exceptions are raised here.
        arguments: one for each job.
        jobs: number of processes. With 1, the jobs run in this process and in order.
        backend: ``loky`` (processes of this machine, the default) or ``ray`` (all processors of a running
            Ray cluster; ``jobs`` is ignored).

    Yields:
        Number and result. The result of a job that lost its worker each time is a :class:`JobError`.

    Raises:
        DependencyError: when Ray is not installed.
        JobError: when the back end is unknown, or no Ray cluster is running.
        ArgumentError: when ``jobs`` is not a whole number above 0.
    """
    whole_number(jobs, "jobs", least=1)
    if backend not in (None, *BACKENDS):
        raise JobError(f"no back end {backend!r}; valid: {', '.join(BACKENDS)}")
    if backend == "ray":
        outcomes = _run_on_ray(function, arguments)
    elif jobs > 1:
        outcomes = _run_on_processes(function, arguments, jobs)
    else:
        outcomes = ((number, function(argument), None) for number, argument in enumerate(arguments))
    # Joblib's generator must be closed in this thread, and the traceback of a raised error keeps it alive.
    with closing(outcomes):
        for number, result, error in outcomes:
            if error is not None:
                raise error
            yield number, result


def _run_on_processes(
    function: Callable[[Any], Any], arguments: Sequence[Any], jobs: int
) -> Generator[_Outcome]:
    call = partial(_call, function, _paths())
    waiting = dict(enumerate(arguments))
    while waiting:
        before = len(waiting)
        with suppress(BrokenProcessPool):
            for outcome in _run_side_by_side(call, waiting, jobs):
                del waiting[outcome[0]]
                yield outcome
        if len(waiting) == before:
            # A job that takes down its worker takes others with it. Alone, each shows whether it does.
            number = min(waiting)
            yield _run_alone(call, number, waiting.pop(number), jobs)


def _run_alone(call: Callable[[int, Any], _Outcome], number: int, argument: Any, jobs: int) -> _Outcome:
    for _ in range(ATTEMPTS):
        try:
            (outcome,) = _run_side_by_side(call, {number: argument}, jobs)
            return outcome
        except BrokenProcessPool as error:
            loss = error
    return number, _lost(loss), None


def _run_side_by_side(
    call: Callable[[int, Any], _Outcome], work: Mapping[int, Any], jobs: int
) -> Iterator[_Outcome]:
    """Yield the outcomes of jobs as they come.

    Raises:
        BrokenProcessPool: when a worker process ends.
    """
    from joblib import Parallel, delayed, parallel_config

    with parallel_config(backend="loky", initializer=_end_with, initargs=(os.getpid(),)):
        pool = Parallel(n_jobs=jobs, return_as="generator_unordered", batch_size=1)
    calls = [delayed(call)(number, argument) for number, argument in work.items()]
    # Joblib replaces a worker that holds much memory after a job, which is no concern of a user.
    warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
    # A Ctrl-C is for this process alone, which ends its workers: a worker would print a traceback. A
    # signal that is blocked here stays blocked in the processes that start now. Python's resource tracker
    # must run before, because starting it unblocks the signal.
    resource_tracker.ensure_running()
    blocked_before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        outcomes = iter(pool(calls))
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked_before)
    yield from outcomes


def _run_on_ray(function: Callable[[Any], Any], arguments: Sequence[Any]) -> Generator[_Outcome]:
    """Run each job as a Ray task.

    Joblib has a Ray back end, but it returns all results at the end or none, and cannot tell which job
    was lost.
    """
    ray = _connected_ray()
    task = ray.remote(num_cpus=1, max_retries=ATTEMPTS - 1)(_call)
    paths = _paths()
    running = {
        task.remote(function, paths, number, argument): number for number, argument in enumerate(arguments)
    }
    while running:
        (finished,), _ = ray.wait(list(running), num_returns=1)
        number = running.pop(finished)
        try:
            yield ray.get(finished)
        except ray.exceptions.RayError as error:
            yield number, _lost(error), None


def _connected_ray() -> Any:
    """Return the module ``ray``, connected to the cluster of ``RAY_ADDRESS`` or of this machine."""
    try:
        import ray
    except ImportError:
        raise missing_dependency("ray", "ray", "the back end ray") from None
    if not ray.is_initialized():
        address = os.environ.get("RAY_ADDRESS", "auto")
        try:
            ray.init(address=address, log_to_driver=False, logging_level="ERROR")
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise JobError(
                f"no Ray cluster can be reached: start one with `ray start --head`, or name it in "
                f"RAY_ADDRESS ({str(error).splitlines()[0][:120]})"
            ) from None
    return ray


def _paths() -> dict[str, str]:
    return {name: str(Path(os.environ[name]).absolute()) for name in _PATHS if name in os.environ}


def _call(function: Callable[[Any], Any], paths: Mapping[str, str], number: int, argument: Any) -> _Outcome:
    """Run a job in a worker, which may live on from an earlier call with other paths."""
    for name in _PATHS:
        os.environ.pop(name, None)
    os.environ.update(paths)
    try:
        return number, function(argument), None
    except Exception as error:
        return number, None, error


def _end_with(parent: int) -> None:
    """Kill this worker as soon as its parent is gone.

    A process that was killed cannot end its workers, and they would go on writing.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_CHECK_EVERY)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def _lost(loss: Exception) -> JobError:
    first_line = (str(loss).strip() or "no reason given").splitlines()[0][:200]
    return JobError(f"lost with its worker {ATTEMPTS} times: {type(loss).__name__}: {first_line}")
