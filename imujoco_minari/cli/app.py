"""The application object, and how every command prints, shows progress and fails."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from traceback import walk_stack
from types import FrameType
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from imujoco_minari.errors import CatalogueError, ImujocoError, VariantError

app = typer.Typer(
    name="imujoco",
    help="Publish, verify and combine Minari datasets of perturbed MuJoCo robots (iMuJoCo).",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode="markdown",
)
INTERRUPTED = 130
out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON, for scripts.")]
Robot = Annotated[str | None, typer.Option("--robot", "-r", help="hopper, halfcheetah or walker2d.")]
Category = Annotated[str | None, typer.Option("--category", "-c", help="mass, joint, length or friction.")]


def main() -> None:
    """Run the command line and exit with its code, which is 130 after a Ctrl-C."""
    interrupted = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted
        interrupted = True
        if any(inner.f_code.co_filename.startswith("<frozen importlib") for inner, _ in walk_stack(frame)):
            # An extension module that is being imported may lose the exception. An import writes nothing,
            # so there is nothing to clean up.
            os._exit(INTERRUPTED)
        # Interrupted work warns and fails in ways that help nobody: joblib warns of the jobs that it
        # cancels, and the thread that hands them out may fail.
        warnings.simplefilter("ignore")
        threading.excepthook = _ignore_thread_exception
        signal.default_int_handler(number, frame)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)
    _name_glfw_library()
    try:
        code = run(sys.argv[1:])
    except (Exception, KeyboardInterrupt):
        # A library may turn the KeyboardInterrupt into an exception of its own.
        if not interrupted:
            raise
        code = INTERRUPTED
    sys.exit(INTERRUPTED if interrupted and code else code)


def _ignore_thread_exception(raised: threading.ExceptHookArgs) -> None:
    """Ignore an exception that ended a thread after an interrupt."""


def _name_glfw_library() -> None:
    """Name the library that the package glfw contains, unless the user names one.

    MuJoCo and Gymnasium import glfw. Without a name, glfw starts a Python process for every library that
    it finds, to ask for its version. That takes 0.2 s, and a Ctrl-C in that time makes the process print
    a traceback.
    """
    package = find_spec("glfw")
    if package is None or package.origin is None or os.environ.get("PYGLFW_LIBRARY"):
        return
    window_system = os.environ.get("PYGLFW_LIBRARY_VARIANT") or os.environ.get("XDG_SESSION_TYPE", "")
    folder = "wayland" if window_system.lower() == "wayland" else "x11"
    library = Path(package.origin).parent / folder / "libglfw.so"
    if library.is_file():
        os.environ["PYGLFW_LIBRARY"] = str(library)


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code; turn what is the user's to mend into one line."""
    try:
        app(list(arguments))
    except SystemExit as exit_:
        return exit_.code if isinstance(exit_.code, int) else int(bool(exit_.code))
    except ImujocoError as error:
        fail(str(error))
        return 2 if isinstance(error, VariantError | CatalogueError) else 1
    return 0


def fail(message: str) -> None:
    """Print an error in one line."""
    err.print(f"[bold red]error:[/] {_escape(message)}")


def say(message: str) -> None:
    """Print a line for people; on the error stream, so that standard output holds results only."""
    err.print(_escape(message))


def print_json(value: Any) -> None:
    """Print a value as JSON."""
    sys.stdout.write(json.dumps(value, indent=2, default=str) + "\n")


def print_table(
    columns: Sequence[str], rows: Sequence[Sequence[str]], *, numeric: Sequence[str] = ()
) -> None:
    """Print rows of text as a table, with the columns named in ``numeric`` aligned to the right.

    Rich's own table takes 0.1 s for the catalogue, and cuts columns where it knows no terminal.
    """
    table = [list(columns), *(list(row) for row in rows)]
    widths = [max(map(len, cells)) for cells in zip(*table, strict=True)]
    align = [str.rjust if column in numeric else str.ljust for column in columns]
    lines = [
        "  ".join(place(cell, width) for place, cell, width in zip(align, row, widths, strict=True)).rstrip()
        for row in table
    ]
    out.print(f"[bold]{_escape(lines[0])}[/]")
    if rows:
        out.print("\n".join(lines[1:]), markup=False)


@contextmanager
def progress(description: str, total: int, *, quiet: bool = False) -> Iterator[Callable[[], None]]:
    """Show a bar with an estimate on the error stream, and yield what advances it by one."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=err, disable=quiet or not err.is_terminal) as bar:
        task = bar.add_task(_escape(description), total=total)
        yield lambda: bar.advance(task)


def _escape(text: str) -> str:
    return text.replace("[", r"\[")


def _version(show: bool) -> None:
    if show:
        from imujoco_minari import __version__

        out.print(f"imujoco-minari {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Publish, verify and combine Minari datasets of perturbed MuJoCo robots (iMuJoCo)."""
