"""The application object, and how every command runs and fails."""

from __future__ import annotations

import inspect
import os
import re
import signal
import sys
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from traceback import walk_stack
from types import FrameType
from typing import Annotated, Any, TypeVar

import typer

from imujoco_minari.cli.options import option
from imujoco_minari.cli.printing import fail, out, print_json, progress, say, with_name
from imujoco_minari.envs.registration import load_catalogue
from imujoco_minari.errors import ImujocoError, ImujocoWarning

# Help is plain text: Markdown and Rich's markup take `<variant>` and `[DIR]` for tags and drop them.
app = typer.Typer(
    name="imujoco",
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
    context_settings={"max_content_width": 110},
)
FAILED, MISSING, INTERRUPTED = 1, 2, 130


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
        threading.excepthook = lambda raised: None
        signal.default_int_handler(number, frame)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)
    _open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        # A character that the terminal's encoding lacks is printed as an escape. A log file gets the lines of
        # long work as they are printed.
        stream.reconfigure(errors="backslashreplace", line_buffering=True)  # type: ignore[union-attr]
    _name_glfw_library()
    shown = warnings.showwarning
    warnings.showwarning = lambda message, kind, *rest: (
        say(f"note: {message}") if issubclass(kind, ImujocoWarning) else shown(message, kind, *rest)
    )
    try:
        code = run(sys.argv[1:])
    except (Exception, KeyboardInterrupt):
        # A library may turn the KeyboardInterrupt into an exception of its own.
        if not interrupted:
            raise
        code = INTERRUPTED
    sys.exit(INTERRUPTED if interrupted and code else code)


def _open_closed_streams() -> None:
    """Open the null device for each standard stream that is closed. Python has None for it.

    Otherwise the next file that is opened would take its place, and get what libraries print.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode))  # noqa: SIM115


def _name_glfw_library() -> None:
    """Name the library that the package glfw contains, unless the user names one.

    MuJoCo and Gymnasium import glfw, although the command line opens no window. Without a name, glfw starts
    a Python process for every library that it finds, to ask for its version. That takes 0.2 s, and a Ctrl-C
    in that time makes the process print a traceback.
    """
    package = find_spec("glfw")
    if package is not None and package.origin is not None:
        library = Path(package.origin).parent / "x11" / "libglfw.so"
        if library.is_file():
            os.environ.setdefault("PYGLFW_LIBRARY", str(library))


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code. Print a user's mistake as one line.

    With ``--json``, standard output gets exactly one JSON document, also when the command fails.
    """
    try:
        # The exit code of a command that left by typer.Exit, or None.
        code: int = command().main(list(arguments) or ["--help"], prog_name="imujoco", standalone_mode=False)
        if code != INTERRUPTED:
            return code or 0
        message = "interrupted"
    except typer.TyperException as error:
        context = getattr(error, "ctx", None)
        hint = f"; see `{context.command_path} --help`" if context else ""
        format_message: Callable[[], str] = getattr(error, "format_message", error.__str__)
        message, code = format_message().rstrip(".") + hint, MISSING
    except ImujocoError as error:
        message, code = str(error), exit_code([error.missing])
    except typer.Abort:
        message, code = "stopped: nothing was changed", FAILED
    except Exception as error:
        # This is our mistake: Python shows where it happened.
        if "--json" in arguments:
            print_json({"error": f"{type(error).__name__}: {error}"})
        raise
    if code != INTERRUPTED:
        fail(message)
    if "--json" in arguments:
        print_json({"error": message})
    return code


def command() -> Any:
    """Return the command line as a Click command, with the examples of each help text one a line."""
    root = typer.main.get_command(app)
    for each in _commands(root):
        text, *rest = re.split(r"\n\nExamples?:", inspect.cleandoc(each.help or ""), maxsplit=1)
        shown = ["  " + " ".join(part.split()) for part in re.findall(r"`([^`]+)`", "".join(rest))]
        each.help = text
        # \b keeps Click from joining the lines.
        each.epilog = "\n".join(["\b", "Examples:", *shown]) if shown else None
    return root


def _commands(root: Any) -> Iterator[Any]:
    yield root
    for each in getattr(root, "commands", {}).values():
        yield from _commands(each)


def exit_code(missing: Sequence[bool]) -> int:
    """Return the exit code of failures: 2 when each was a request for something that does not exist."""
    return MISSING if all(missing) else FAILED


_Outcome = TypeVar("_Outcome")


def gather(
    outcomes: Iterable[_Outcome],
    describe: Callable[[_Outcome], tuple[str, ...]],
    *,
    as_json: bool,
    name: str = "dataset_id",
) -> None:
    """Print the outcomes of a batch as they come, and its failures at the end. Exit if one failed.

    Args:
        outcomes: dataclasses with ``error``, which is empty for a success, and ``missing``.
        describe: returns what to print of a success: a verb, the rest of its line, and further lines. The
            last line of the batch counts the verbs.
        as_json: print one JSON document instead of lines.
        name: the attribute of an outcome that names it.
    """
    results: list[dict[str, Any]] = []
    verbs = Counter[str]()
    stopped: ImujocoError | None = None
    try:
        for outcome in outcomes:
            results.append(vars(outcome))
            if not results[-1]["error"]:
                verb, line, *details = describe(outcome)
                verbs[verb] += 1
                if not as_json:
                    out.print(f"{verb} {line}", *details)
    except ImujocoError as error:
        stopped = error
    if as_json:
        print_json(results if stopped is None else {"results": results, "error": str(stopped)})
    failures = [result for result in results if result["error"]]
    for failure in failures:
        fail(with_name(failure[name], failure["error"]))
    if len(results) > 1:
        say(", ".join([*(f"{verb} {count}" for verb, count in verbs.items()), f"failed {len(failures)}"]))
    missing = [failure["missing"] for failure in failures]
    if stopped is not None:
        fail(str(stopped))
        missing.append(stopped.missing)
    if missing:
        raise typer.Exit(exit_code(missing))


def advancing(outcomes: Iterable[_Outcome], description: str, total: int) -> Iterator[_Outcome]:
    """Yield the outcomes of a batch behind a bar that each of them advances by one."""
    with progress(description, total) as advance:
        for outcome in outcomes:
            yield outcome
            advance()


def _version(show: bool) -> None:
    if show:
        from imujoco_minari import __version__

        out.print(f"imujoco-minari {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    catalogue: Annotated[
        list[Path] | None,
        option("--catalogue DIR", "A folder with pages of your own robots, or one page; may be repeated."),
    ] = None,
    version: Annotated[
        bool, option("--version", "Print the version.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Publish, verify and combine Minari datasets of perturbed MuJoCo robots (iMuJoCo)."""
    for folder in catalogue or []:
        load_catalogue(folder)
