"""Ctrl-C: exit code 130, no traceback, no worker left, nothing half-made visible."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest
from processes import running

from imujoco_minari.envs.registration import environment_spec
from imujoco_minari.errors import PolicyError
from imujoco_minari.publishing.collector import collect
from imujoco_minari.storage import quiet_file, transactions

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for orphans in /proc")


@pytest.fixture(autouse=True)
def heed_interrupts() -> Iterator[None]:
    """Let child processes be interrupted, also where tests run in the background of a script.

    Such a script ignores interrupts, and a child inherits that. A handler is not inherited.
    """
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, previous)


@pytest.mark.parametrize("whole_group", [True, False], ids=["as a terminal does", "the parent only"])
@pytest.mark.parametrize("jobs", ["1", "2"])
def test_publish(jobs: str, whole_group: bool, root: Path) -> None:
    words = ("publish", "hopper-base", "-t", "random", "-n", "100000", "--jobs", jobs)
    process = subprocess.Popen(
        [sys.executable, "-m", "imujoco_minari", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    # Episodes are being written when the file is there.
    end = time.monotonic() + 60
    while not list(root.rglob("main_data.hdf5")) and time.monotonic() < end:
        time.sleep(0.05)
    (os.killpg if whole_group else os.kill)(process.pid, signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, output) == (130, "")
    assert minari.list_local_datasets() == {}
    end = time.monotonic() + 20
    while running(process.pid) and time.monotonic() < end:
        time.sleep(0.05)
    assert running(process.pid) == []
    transactions.tidy()
    assert not (root / transactions.STAGING).exists()
    assert "Traceback" not in errors
    assert "Warning" not in errors


@pytest.mark.parametrize("called", ["write", "truncate"])
def test_one_that_comes_while_hdf5_calls_our_file_comes_after(
    called: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    method, calls = getattr(io.FileIO, called), []

    class Interrupted(io.FileIO):
        """What the quiet file calls: the first call is interrupted."""

    def interrupted(self: io.FileIO, *arguments: object) -> object:
        if not calls:
            calls.append(called)
            signal.raise_signal(signal.SIGINT)
        return method(self, *arguments)

    setattr(Interrupted, called, interrupted)
    path = tmp_path / "file.hdf5"
    path.touch()

    def write() -> None:
        with quiet_file.writing(path) as file:
            for number in range(1000):
                file[str(number)] = np.arange(1000)
                file.flush()

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    quiet_file._QuietFile.__bases__ = (Interrupted,)
    try:
        with pytest.raises(KeyboardInterrupt):
            write()
    finally:
        quiet_file._QuietFile.__bases__ = (io.FileIO,)
        restored = signal.signal(signal.SIGINT, handler)
    assert calls == [called]
    assert capfd.readouterr().err == ""
    # HDF5 closed the file in peace.
    with h5py.File(path, "r") as file:
        assert np.array_equal(file["0"], np.arange(1000))
    assert restored is signal.default_int_handler


@pytest.fixture
def default_handler() -> Iterator[None]:
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.signal(signal.SIGINT, handler) is signal.default_int_handler


def test_a_delayed_one_is_raised_at_the_next_safe_point(tmp_path: Path, default_handler: None) -> None:
    path = tmp_path / "file.hdf5"

    def write() -> None:
        with quiet_file.writing(path, new=True) as file:
            for number in range(10):
                quiet_file.safe_point()
                if number == 3:
                    signal.raise_signal(signal.SIGINT)
                file[str(number)] = np.arange(1000)

    path.touch()
    with pytest.raises(KeyboardInterrupt):
        write()
    with h5py.File(path, "r") as file:
        assert set(file) == set("0123")


def test_a_delayed_one_is_raised_by_the_outer_block_and_once(default_handler: None) -> None:
    ended = []

    def nested() -> None:
        with quiet_file.delayed_interrupts():
            with quiet_file.delayed_interrupts():
                signal.raise_signal(signal.SIGINT)
                signal.raise_signal(signal.SIGINT)
            ended.append("inner")
            with pytest.raises(KeyboardInterrupt):
                quiet_file.safe_point()
            quiet_file.safe_point()
            signal.raise_signal(signal.SIGINT)
            ended.append("outer")

    with pytest.raises(KeyboardInterrupt):
        nested()
    assert ended == ["inner", "outer"]
    quiet_file.safe_point()


def test_a_thread_neither_delays_nor_raises_one(default_handler: None) -> None:
    def handlers() -> list[Any]:
        before = signal.getsignal(signal.SIGINT)
        with quiet_file.delayed_interrupts():
            quiet_file.safe_point()
            return [before, signal.getsignal(signal.SIGINT)]

    def interrupt(thread: ThreadPoolExecutor) -> None:
        with quiet_file.delayed_interrupts():
            signal.raise_signal(signal.SIGINT)
            assert thread.submit(handlers).result() == [signal.getsignal(signal.SIGINT)] * 2

    with ThreadPoolExecutor(1) as thread:
        assert thread.submit(handlers).result() == [signal.default_int_handler] * 2
        with pytest.raises(KeyboardInterrupt):
            interrupt(thread)


def test_a_policy_that_fails_leaves_no_interrupt_delayed(tmp_path: Path, default_handler: None) -> None:
    """Random episodes of Hopper take some ten steps, so the file is open when the policy fails."""

    class Failing:
        calls = 0

        def act(self, observation: Any, rng: np.random.Generator) -> Any:
            self.calls += 1
            if self.calls > 3000:
                raise PolicyError("no more")
            return rng.uniform(-1.0, 1.0, 3).astype(np.float32)

    with pytest.raises(PolicyError, match="no more"):
        collect(environment_spec("hopper-base"), Failing(), range(1000), 0, tmp_path / "data")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_the_command_line_imports_mujoco_without_a_child_process() -> None:
    """Glfw would start one, and an interrupt would make that one print a traceback."""
    script = """
import subprocess, sys
from imujoco_minari.cli import app

def run(arguments):
    def refuse(*words, **options):
        raise AssertionError(f"started {words}")

    subprocess.Popen.__init__ = refuse
    import imujoco_minari.envs.robots
    import glfw
    assert glfw.get_version() >= (3, 3)
    return 7

sys.modules["imujoco_minari.cli.app"].run = run
sys.modules["imujoco_minari.cli.app"].main()
"""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYGLFW")}
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, env=environment
    )
    assert (done.returncode, done.stderr) == (7, "")


def result_of(script: str, folder: Path | None = None) -> tuple[int, str, str]:
    """Run a script in a Python process and return its exit code, output and errors."""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, cwd=folder
    )
    return done.returncode, done.stdout, done.stderr


def test_one_that_an_import_loses_is_one_all_the_same(tmp_path: Path) -> None:
    (tmp_path / "loses_interrupts.py").write_text("""
import signal
try:
    signal.raise_signal(signal.SIGINT)
except BaseException:
    pass
""")
    script = """
import importlib
app = importlib.import_module("imujoco_minari.cli.app")

def run(arguments):
    import loses_interrupts
    return 0

app.run = run
app.main()
"""
    assert result_of(script, tmp_path) == (130, "", "")


@pytest.mark.parametrize("becomes", ["ImportError('initialization failed')", "interrupt"])
def test_one_that_ends_as_something_else_is_one_all_the_same(becomes: str) -> None:
    script = f"""
import importlib, signal
app = importlib.import_module("imujoco_minari.cli.app")

def run(arguments):
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt as interrupt:
        raise {becomes} from None

app.run = run
app.main()
"""
    assert result_of(script) == (130, "", "")
