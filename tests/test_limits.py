"""Child processes with limits: every way in which a call can end."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from imujoco_minari import limits
from imujoco_minari.errors import JobError
from imujoco_minari.limits import run_all_limited, run_limited

LIMITS = {"memory": 2**28, "seconds": 5}


def test_a_result_comes_back_whatever_is_printed() -> None:
    assert run_limited("limited_calls:echo", "ä \0 \n", **LIMITS) == "ä \0 \n".encode()


@pytest.mark.parametrize(
    ("function", "argument", "message"),
    [
        ("crash", "", r"kills the process \(SIGSEGV\)"),
        ("fail", "", "fails: ValueError: too much"),
        ("allocate", str(2**29), f"needs more than {2**28} bytes of memory"),
    ],
)
def test_a_call_that_breaks_is_an_error(function: str, argument: str, message: str) -> None:
    with pytest.raises(JobError, match=message):
        run_limited(f"limited_calls:{function}", argument, **LIMITS)


def test_a_call_within_the_limits_is_no_error() -> None:
    assert run_limited("limited_calls:allocate", str(2**26), **LIMITS)


def test_a_call_that_computes_or_waits_for_ever_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(JobError, match="takes more than 1 seconds of processor time"):
        run_limited("limited_calls:compute", "", memory=2**28, seconds=1)
    monkeypatch.setattr(limits, "WAIT_SECONDS", 4)
    started = time.monotonic()
    with pytest.raises(JobError, match=r"takes more than 5 seconds$"):
        run_limited("limited_calls:wait", "", memory=2**28, seconds=1)
    assert time.monotonic() - started < 60


def test_calls_run_side_by_side_and_one_that_breaks_stops_no_other() -> None:
    first, second = run_all_limited("limited_calls:allocate", [str(2**29), "5"], **LIMITS)
    assert isinstance(first, JobError)
    assert second


def test_a_smaller_limit_of_the_system_stays_in_force() -> None:
    """As on a cluster with `ulimit -v`: the hard limit is below the one asked for."""
    code = (
        "from imujoco_minari.limits import run_limited\n"
        "print(run_limited('limited_calls:address_space_limit', '', memory=2**33, seconds=5).decode())"
    )
    allowed = 6_000_000 * 1024
    done = subprocess.run(
        ["sh", "-c", f'ulimit -v {allowed // 1024}; exec "$@"', "sh", sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert int(done.stdout) == allowed
