"""Ctrl-C: at once, exit code 130, no traceback, no orphan, nothing half-made to be seen."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import minari
import numpy as np
import pytest
from processes import running

from imujoco_minari.storage import minari_root, quiet_file

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for orphans in /proc")


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
        # What runs in the background of a script, as tests may, ignores interrupts, and so do its children.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
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
    minari_root.tidy()
    assert not (root / minari_root.STAGING).exists()
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
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
