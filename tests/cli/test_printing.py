"""Text from outside reaches the terminal as text: no control characters, no markup, no broken encoding."""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np
import pytest
from rich.console import Console

from imujoco_minari.cli.app import run
from imujoco_minari.cli.printing import err, fail, out, print_table, printable, progress
from imujoco_minari.storage.file_format import main_file

BASE_ID = "imujoco/hopper-base-random-v0"
# It sets a terminal's title, clears its screen, reverses its text and forges a line.
EVIL = "\x1b]0;title\x07\x1b[2J\u202e\r\nerror: forged"
HOSTILE = [EVIL, "[bold]red[/]", "[/]", ":warning:", "\udcff\udcfe", "a\\b"]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain ± text", "plain ± text"),
        ("\x1b[31m", "\\x1b[31m"),
        ("two\nlines\ttab", "two\\nlines\\ttab"),
        ("\udcff", "\\udcff"),
        ("\u202e\u2028\x9b", "\\u202e\\u2028\\x9b"),
        ("[bold]", "[bold]"),
    ],
)
def test_what_a_terminal_would_obey_becomes_an_escape(text: str, shown: str) -> None:
    assert printable(text) == shown


@pytest.mark.parametrize("text", HOSTILE)
def test_each_way_of_printing_prints_it_as_text(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    shown = printable(text)
    out.print(text, f"  at {text}", style="bold")
    fail(text)
    print_table(("where", "what"), [[text, "b"], ["a", text]])
    output = capsys.readouterr()
    header = "where".ljust(max(5, len(shown)))
    lines = [shown, f"  at {shown}", f"{header}  what", f"{shown.ljust(len(header))}  b"]
    assert output.out.splitlines() == [*lines, f"{'a'.ljust(len(header))}  {shown}"]
    assert output.err == f"error: {shown}\n"


@pytest.mark.parametrize("text", HOSTILE)
def test_a_bar_is_named_as_text(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=200, color_system=None)
    monkeypatch.setattr(err, "console", console)
    with progress(text, 2) as advance:
        advance()
    assert printable(text) in console.file.getvalue()  # type: ignore[attr-defined]
    assert "\x1b]" not in console.file.getvalue()  # type: ignore[attr-defined]


def test_lines_go_above_a_bar_on_the_same_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    for printer in (out, err):
        console = Console(file=screen, force_terminal=True, width=200, color_system=None)
        monkeypatch.setattr(printer, "console", console)
    with progress("bar", 2) as advance:
        out.print("a result")
        advance()
    before = screen.getvalue().partition("a result")[0]
    # The line of the bar was cleared.
    assert before.endswith("\x1b[2K")


def test_a_log_gets_lines_instead_of_a_bar(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("imujoco_minari.cli.printing.LINE_SECONDS", 0.0)
    with progress("training", 4) as advance:
        advance(2)
        advance()
    # What was known before, in one step, says nothing of the speed.
    assert re.fullmatch(r"training: 2 of 4\ntraining: 3 of 4, 0:00:0\d left\n", capsys.readouterr().err)
    monkeypatch.setattr("imujoco_minari.cli.printing.LINE_SECONDS", 60.0)
    with progress("training", 4) as advance:
        advance()
    assert capsys.readouterr().err == ""


@pytest.fixture
def hostile_names(small_datasets: list[str], root: Path) -> str:
    """A dataset whose HDF5 file holds hostile names."""
    with h5py.File(main_file(root / BASE_ID / "data"), "a") as file:
        episode = file["episode_0"]
        for name in HOSTILE:
            place = name.encode("utf-8", "surrogateescape").replace(b"/", b"|")
            episode[place] = np.zeros(3)
    return BASE_ID


def imujoco(arguments: Sequence[str], **environment: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-m", "imujoco_minari", *arguments],
        env=os.environ | environment,
        capture_output=True,
        check=False,
    )


def test_the_findings_of_verify_name_hdf5_names_as_text(
    hostile_names: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["verify", hostile_names]) == 1
    output = capsys.readouterr()
    assert (output.out + output.err).replace("\n", "").isprintable()
    for name in ("\\x1b]0;title\\x07", "[bold]red[|]", "\\udcff"):
        assert name in output.out
    assert "\nerror: forged" not in output.out


@pytest.mark.parametrize("encoding", ["ascii", "utf-8:strict"])
@pytest.mark.parametrize("as_json", [[], ["--json"]], ids=["text", "json"])
def test_the_findings_of_verify_fit_the_encoding(
    encoding: str, as_json: list[str], hostile_names: str
) -> None:
    done = imujoco(["verify", hostile_names, *as_json], PYTHONIOENCODING=encoding, PYTHONUTF8="0")
    assert (done.returncode, b"Traceback" in done.stderr) == (1, False)
    assert b"title" in done.stdout
    assert b"\x1b" not in done.stdout
    done.stdout.decode(encoding.partition(":")[0])


def test_results_fit_an_ascii_terminal() -> None:
    done = imujoco(["publish", "hopper-base", "-t", "random", "-n", "2"], PYTHONIOENCODING="ascii")
    assert done.returncode == 0, done.stderr
    assert b"return " in done.stdout
    assert b" \\xb1 " in done.stdout
    assert imujoco(["publish", "--help"], PYTHONIOENCODING="ascii").returncode == 0


@pytest.fixture
def short_folder() -> Iterator[Path]:
    """A folder whose path no message cuts, as it may cut that of ``tmp_path``."""
    with TemporaryDirectory() as folder:
        yield Path(folder)


@pytest.mark.parametrize("folder", ["[bold]", "[/]", "\x1b[31m", ":warning:"])
def test_folders_are_named_as_they_are(
    folder: str,
    small_datasets: list[str],
    root: Path,
    short_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    place = short_folder / folder
    place.parent.mkdir(exist_ok=True)
    shutil.copytree(root, place)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(place))
    monkeypatch.setenv("IMUJOCO_HOME", str(place / "home"))
    shown = printable(short_folder / folder)
    for arguments, code in (
        (["publish", "hopper-base", "-t", "random", "-n", "8"], 0),
        (["list", "--robot", "hopper"], 0),
        (["policies", "--robot", "hopper"], 0),
        (["export", BASE_ID, "--format", "npz", "--output", str(place / "x.npz")], 0),
        (["verify", "imujoco/hopper-none-v0"], 2),
        (["publish", "hopper-base", "-t", "mine", "--policy", str(place / "none.zip")], 2),
        (["import-archive", str(place / "none")], 2),
        (["render", str(place)], 2),
    ):
        assert run(arguments) == code, arguments
        output = capsys.readouterr()
        assert shown in output.out + output.err, arguments
