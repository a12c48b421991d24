"""Runs a function on untrusted input in child processes, with limits on their memory and their time.

Some inputs crash a library, take all memory or never end, whatever is checked beforehand. The limits of a
process hold for the whole input. A smaller limit that is already set (``ulimit``) stays in force.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from imujoco_minari.errors import JobError

# Wall-clock time beyond the processor time that a call may take. It ends a child that waits for something.
# Processor time is the limit for a child that computes, so a busy machine does not matter.
WAIT_SECONDS = 240

_PROGRAM = "import json, sys; call = json.loads(sys.argv[1]); sys.path[:] = call.pop('path'); \
from imujoco_minari.limits import answer; answer(**call)"
_ADDRESS_SPACE = Path("/proc/self/statm")


def run_limited(function: str, argument: str, *, memory: int, seconds: int) -> bytes:
    """Call a function in a child process and return its result.

    The child imports the function's module before the limits are set. So they are limits on the call
    alone, and need not allow for the size of the imported libraries.

    Args:
        function: ``module:name`` of a function from ``str`` to ``bytes``.
        argument: its argument, short: the path of a file where there is much to pass on.
        memory: address space that the call may add, in bytes. Not limited on systems without ``/proc``.
        seconds: processor time that the call may take.

    Raises:
        JobError: when the child exceeds a limit, crashes, or raises an exception.
    """
    (result,) = run_all_limited(function, [argument], memory=memory, seconds=seconds)
    if isinstance(result, JobError):
        raise result
    return result


def run_all_limited(
    function: str, arguments: Sequence[str], *, memory: int, seconds: int
) -> list[bytes | JobError]:
    """Call a function as :func:`run_limited` does, in one child for each argument, all at once.

    Returns:
        For each argument the result, or the error.
    """
    deadline = time.monotonic() + seconds + WAIT_SECONDS
    children: list[subprocess.Popen[bytes]] = []
    try:
        for argument in arguments:
            call = {
                "path": sys.path,
                "function": function,
                "argument": argument,
                "memory": memory,
                "seconds": seconds,
            }
            children.append(
                subprocess.Popen(
                    [sys.executable, "-c", _PROGRAM, json.dumps(call)],
                    # More threads would reserve more address space.
                    env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                )
            )
        # One after the other: a child that waits for its result to be read has done its work.
        return [_result(child, deadline, memory, seconds) for child in children]
    finally:
        for child in children:
            child.kill()
            child.communicate()


def answer(function: str, argument: str, memory: int, seconds: int) -> None:
    """Call the function under the limits and print its result. This is what the child process runs."""
    result = os.dup(sys.stdout.fileno())
    # A library may print; that is no part of the result.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    module, _, name = function.partition(":")
    called: Callable[[str], bytes] = getattr(importlib.import_module(module), name)
    _limit_this_process(memory, seconds)
    with os.fdopen(result, "wb") as file:
        file.write(called(argument))


def _result(child: subprocess.Popen[bytes], deadline: float, memory: int, seconds: int) -> bytes | JobError:
    try:
        output, complaint = child.communicate(timeout=max(0.0, deadline - time.monotonic()))
    except subprocess.TimeoutExpired:
        return JobError(f"takes more than {seconds + WAIT_SECONDS} seconds")
    if child.returncode == -signal.SIGXCPU:
        return JobError(f"takes more than {seconds} seconds of processor time")
    if child.returncode < 0:
        return JobError(f"kills the process ({signal.Signals(-child.returncode).name})")
    if child.returncode:
        lines = complaint.decode("utf-8", "replace").strip().splitlines()
        reason = lines[-1] if lines else "no reason given"
        if reason.startswith("MemoryError"):
            return JobError(f"needs more than {memory} bytes of memory")
        return JobError(f"fails: {reason[:200]}")
    return output


def _limit_this_process(memory: int, seconds: int) -> None:
    _lower(resource.RLIMIT_CORE, 0)
    if _ADDRESS_SPACE.exists():
        pages = int(_ADDRESS_SPACE.read_text().split()[0])
        _lower(resource.RLIMIT_AS, pages * resource.getpagesize() + memory)
    used = resource.getrusage(resource.RUSAGE_SELF)
    _lower(resource.RLIMIT_CPU, math.ceil(used.ru_utime + used.ru_stime) + seconds)


def _lower(kind: int, limit: int) -> None:
    """Set a soft limit, but never raise it."""
    soft, hard = resource.getrlimit(kind)
    set_limits = (each for each in (soft, hard) if each != resource.RLIM_INFINITY)
    resource.setrlimit(kind, (min([limit, *set_limits]), hard))
