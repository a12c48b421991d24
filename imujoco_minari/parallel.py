"""Independent jobs on several processes or machines; a job that is lost is run again.

Through joblib, but on Ray: joblib's Ray back end gives all results at the end or none, and cannot say
which job was lost, while Ray's own tasks can.

A worker may be killed, by the system for its memory or with its machine. Every job here publishes,
trains or verifies one thing and is safe to run twice, so what had no result when workers were lost is
simply handed out again.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from imujoco_minari.errors import DependencyError, JobError

Argument = TypeVar("Argument")
Result = TypeVar("Result")
# A job's number, and its result or what it raised.
_Called: TypeAlias = tuple[int, Any, Exception | None]

BACKENDS = ("loky", "ray", "dask")
# How often a job may take its worker down before it is given up.
ATTEMPTS = 3

# Seconds between a worker's looks at whether the process that it works for is still there.
_LOOK_EVERY = 0.5

# What decides where things are read and written, and so must be the same on every worker.
_PLACES = ("MINARI_DATASETS_PATH", "IMUJOCO_HOME")


def run_jobs(
    function: Callable[[Argument], Result],
    arguments: Sequence[Argument],
    *,
    jobs: int = 1,
    backend: str | None = None,
) -> Iterator[tuple[int, Result | JobError]]:
    """Call ``function`` with each argument and yield, as they come, the argument's number and the result.

    Args:
        function: picklable, and safe to run twice with one argument; what it raises is raised here.
        arguments: one a job.
        jobs: how many are worked on at once. With 1 they are worked on here, in their order; on a
            cluster 1 means all of its processors.
        backend: ``loky`` (processes of this machine, the default), or a running cluster: ``ray`` or
            ``dask``.

    Yields:
        Number and result; a :class:`JobError` as the result of a job whose workers were lost each time.

    Raises:
        DependencyError: when the back end is not installed.
        JobError: when there is no such back end, or no such cluster is running.
    """
    if backend is not None and backend not in BACKENDS:
        raise JobError(f"no back end {backend!r}; valid: {', '.join(BACKENDS)}")
    if jobs == 1 and backend is None:
        for number, argument in enumerate(arguments):
            yield number, function(argument)
        return
    if backend == "ray":
        _connect_ray()
    elif backend == "dask":
        _connect_dask()
        jobs = -1 if jobs == 1 else jobs
    places = {name: _absolute(os.environ.get(name)) for name in _PLACES}
    if backend == "ray":
        yield from _run_on_ray(function, places, arguments)
        return
    call = partial(_call, function, places)
    waiting, alone, losses = dict(enumerate(arguments)), False, 0
    while waiting:
        before, lost = len(waiting), None
        # A job that takes its worker down takes others with it: after a round without a result, one at
        # a time shows which.
        handed_out = dict([*waiting.items()][:1]) if alone else dict(waiting)
        finished = _round(call, handed_out, jobs, backend)
        while True:
            try:
                number, result, raised = next(finished)
            except StopIteration:
                break
            except Exception as error:  # each back end has errors of its own for a worker that is gone
                lost = error
                break
            del waiting[number]
            if raised is not None:
                raise raised
            yield number, result
        losses = losses + 1 if alone and lost is not None else 0
        alone = len(waiting) == before
        if losses == ATTEMPTS:
            (number,) = handed_out
            del waiting[number]
            yield number, _given_up(lost)
            alone, losses = False, 0


def _round(
    call: Callable[[int, Any], _Called], work: dict[int, Any], jobs: int, backend: str | None
) -> Iterator[_Called]:
    from joblib import Parallel, delayed, parallel_config

    # Processes of this machine learn at their start whom they work for: a job may never reach them.
    watching = {} if backend == "dask" else {"initializer": _end_with, "initargs": (os.getpid(),)}
    # The configuration knows Dask's back end, which Parallel does not until it has been named here.
    with parallel_config(backend=backend or "loky", **watching):
        pool = Parallel(n_jobs=jobs, return_as="generator_unordered", batch_size=1)
    # The call hands out the first jobs, and so starts the processes; what keeps their books comes before,
    # since Python, having started that, lets interrupts in.
    resource_tracker.ensure_running()
    with _uninterrupted():
        return iter(pool(delayed(call)(number, argument) for number, argument in work.items()))


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Hold a Ctrl-C back, and for good from the processes that are started meanwhile.

    It is the parent that ends them. A terminal's Ctrl-C reaches all of a group, and one that is still
    importing would say so with a traceback.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _run_on_ray(
    function: Callable[[Any], Any], places: dict[str, str | None], arguments: Sequence[Any]
) -> Iterator[tuple[int, Any]]:
    """Run all as tasks of the Ray cluster, each on one of its processors."""
    import ray
    from ray.exceptions import RayError

    # Lost tasks are counted here, so that Ray and we do not both run them again.
    task = ray.remote(num_cpus=1, max_retries=0)(_call)
    running = {
        task.remote(function, places, number, argument): number for number, argument in enumerate(arguments)
    }
    losses = dict.fromkeys(range(len(arguments)), 0)
    while running:
        (finished,), _ = ray.wait(list(running), num_returns=1)
        number = running.pop(finished)
        try:
            _, result, raised = ray.get(finished)
        except RayError as error:
            losses[number] += 1
            if losses[number] < ATTEMPTS:
                running[task.remote(function, places, number, arguments[number])] = number
            else:
                yield number, _given_up(error)
            continue
        if raised is not None:
            raise raised
        yield number, result


def _call(
    function: Callable[[Any], Any],
    places: dict[str, str | None],
    number: int,
    argument: Any,
) -> _Called:
    """Call ``function`` in a worker."""
    for name, place in places.items():
        # A worker lives on from an earlier call, or on another machine, with an environment of its own.
        if place is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = place
    try:
        return number, function(argument), None
    except Exception as error:
        return number, None, error


def _end_with(owner: int) -> None:
    """Kill this process, from now on, as soon as its parent ``owner`` is gone.

    A killed process cannot tell its workers, and they would write and train on with nobody to wait for
    them. A thread that looks works on every system, and whichever thread of the parent started us.
    """

    def watch() -> None:
        while os.getppid() == owner:
            time.sleep(_LOOK_EVERY)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, name="ends with its owner", daemon=True).start()


def _given_up(error: Exception | None) -> JobError:
    first_line = (str(error).strip() or "no reason given").splitlines()[0][:200]
    return JobError(f"lost with its worker {ATTEMPTS} times: {type(error).__name__}: {first_line}")


def _absolute(path: str | None) -> str | None:
    return None if path is None else str(Path(path).absolute())


def _connect_ray() -> None:
    """Connect to the Ray cluster that is named in ``RAY_ADDRESS`` or runs here, unless the caller has."""
    try:
        import ray
    except ImportError:
        raise _missing("ray", "ray") from None
    if not ray.is_initialized():
        try:
            ray.init(
                address=os.environ.get("RAY_ADDRESS", "auto"), log_to_driver=False, logging_level="ERROR"
            )
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise JobError(
                f"no Ray cluster can be reached: start one with `ray start --head`, or name it in "
                f"RAY_ADDRESS ({str(error).splitlines()[0][:120]})"
            ) from None


def _connect_dask() -> None:
    """Connect to the Dask cluster that is named in ``DASK_SCHEDULER_ADDRESS``, unless the caller has."""
    try:
        from distributed import Client, get_client
    except ImportError:
        raise _missing("distributed", "dask[distributed]") from None
    try:
        get_client()
    except ValueError:
        address = os.environ.get("DASK_SCHEDULER_ADDRESS")
        if not address:
            raise JobError(
                "no Dask cluster is known: start one with `dask scheduler` and `dask worker`, and name "
                "its scheduler in DASK_SCHEDULER_ADDRESS"
            ) from None
        try:
            Client(address)
        except OSError as error:
            raise JobError(f"no Dask scheduler answers at {address}: {error}") from None


def _missing(package: str, requirement: str) -> DependencyError:
    return DependencyError(
        f'the back end needs {package}, which is not installed: run `pip install "{requirement}"`'
    )
