"""A function in a child process returns its result, or exceeds a limit and is an error of one line."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from imujoco_minari import limits
from imujoco_minari.errors import JobError
from imujoco_minari.limits import run_limited

MEMORY, SECONDS = 2**27, 3


def shout(text: str) -> bytes:
    print("a library says something")
    return text.upper().encode()


def allocate(count: str) -> bytes:
    return bytes(int(count))[:1]


def spin(_: str) -> bytes:
    while True:
        pass


def sleep(_: str) -> bytes:
    time.sleep(60)
    return b""


def die(_: str) -> bytes:
    os.kill(os.getpid(), signal.SIGSEGV)
    return b""


def fail(text: str) -> bytes:
    raise ValueError(text)


def soft_limits(_: str) -> bytes:
    kinds = resource.RLIMIT_AS, resource.RLIMIT_CPU
    return " ".join(str(resource.getrlimit(kind)[0]) for kind in kinds).encode()


def call(function: str, argument: str = "", memory: int = MEMORY, seconds: int = SECONDS) -> bytes:
    return run_limited(f"test_limits:{function}", argument, memory=memory, seconds=seconds)


def test_the_result_comes_back_without_what_was_printed() -> None:
    assert call("shout", "quite \0 so") == b"QUITE \0 SO"


def test_memory_is_limited() -> None:
    assert call("allocate", str(MEMORY // 2)) == b"\0"
    with pytest.raises(JobError, match=f"needs more than {MEMORY} bytes of memory"):
        call("allocate", str(2 * MEMORY))


def test_processor_time_is_limited() -> None:
    started = time.monotonic()
    with pytest.raises(JobError, match="takes more than 1 seconds of processor time"):
        call("spin", seconds=1)
    assert time.monotonic() - started < 120


def test_waiting_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "MAX_WALL_SECONDS", 1)
    with pytest.raises(JobError, match="takes more than 1 seconds"):
        call("sleep")


def test_a_crash_and_an_exception_are_named() -> None:
    with pytest.raises(JobError, match=r"kills the process \(SIGSEGV\)"):
        call("die")
    with pytest.raises(JobError, match="fails: ValueError: so it is"):
        call("fail", "so it is")


def test_a_smaller_limit_that_is_already_set_stays(tmp_path: Path) -> None:
    """As with ``ulimit -v`` on a cluster: a larger limit could not be set, and would be wrong."""
    program = (
        "import resource\n"
        "for kind, limit in ((resource.RLIMIT_AS, 3 * 2**30), (resource.RLIMIT_CPU, 50)):\n"
        "    resource.setrlimit(kind, (limit, limit))\n"
        "from imujoco_minari.limits import run_limited\n"
        "print(run_limited('test_limits:soft_limits', '', memory=2**40, seconds=1000).decode())\n"
    )
    here = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": here},
    )
    assert done.stdout.split() == [str(3 * 2**30), "50"]
