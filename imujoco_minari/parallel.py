"""Independent jobs on several processes or machines, through joblib; a job that is lost is run again.

A worker may be killed, by the system for its memory or with its machine. Every job here publishes,
trains or verifies one thing and is safe to run twice, so what had no result when workers were lost is
simply handed out again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from imujoco_minari.errors import DependencyError, JobError

Argument = TypeVar("Argument")
Result = TypeVar("Result")

BACKENDS = ("loky", "multiprocessing", "ray", "dask")
CLUSTERS = ("ray", "dask")
# How often a job may take its worker down before it is given up.
ATTEMPTS = 3

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
        backend: ``loky`` (processes of this machine, the default), ``multiprocessing``, or a running
            cluster: ``ray`` or ``dask``.

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
    if backend in CLUSTERS:
        _connect(backend)
        jobs = -1 if jobs == 1 else jobs
    places = {name: _absolute(os.environ.get(name)) for name in _PLACES}
    waiting, alone, losses = dict(enumerate(arguments)), False, 0
    while waiting:
        before, lost = len(waiting), None
        # A job that takes its worker down takes others with it: after a round without a result, one at
        # a time shows which.
        handed_out = dict([*waiting.items()][:1]) if alone else dict(waiting)
        finished = _round(function, handed_out, places, jobs, backend)
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
            yield number, JobError(f"lost with its worker {ATTEMPTS} times: {type(lost).__name__}: {lost}")
            alone, losses = False, 0


def _round(
    function: Callable[[Argument], Result],
    work: dict[int, Argument],
    places: dict[str, str | None],
    jobs: int,
    backend: str | None,
) -> Iterator[tuple[int, Any, Exception | None]]:
    from joblib import Parallel, delayed

    pool = Parallel(n_jobs=jobs, backend=backend, return_as="generator_unordered", batch_size=1)
    yield from pool(delayed(_call)(function, number, argument, places) for number, argument in work.items())


def _call(
    function: Callable[[Argument], Result], number: int, argument: Argument, places: dict[str, str | None]
) -> tuple[int, Result | None, Exception | None]:
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


def _absolute(path: str | None) -> str | None:
    return None if path is None else str(Path(path).absolute())


def _connect(backend: str) -> None:
    """Connect to the cluster that runs already; its address is in ``RAY_ADDRESS`` or known to Ray, or in
    ``DASK_SCHEDULER_ADDRESS``, unless the caller has connected.
    """
    if backend == "ray":
        _connect_ray()
    else:
        _connect_dask()


def _connect_ray() -> None:
    try:
        import ray
        from ray.util.joblib import register_ray
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
    register_ray()


def _connect_dask() -> None:
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
