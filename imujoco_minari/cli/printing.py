"""How commands print: lines, tables, JSON documents and progress bars."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

from rich import progress as bars
from rich.console import Console
from rich.text import Text

# An estimate is of the speed in this time, and a log gets a line after at least this time.
ESTIMATE_SECONDS, LINE_SECONDS = 3600.0, 60.0


def printable(text: object) -> str:
    r"""Return text from outside so that a terminal shows it as it is, in one line.

    Control characters, line breaks, characters that change the direction of text, and bytes that are
    not UTF-8 become escapes such as ``\x1b``. Ids, paths, HDF5 names and messages may hold any of them.
    """
    text = str(text)
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class Printer:
    """Print lines to standard output or error. A line may hold text from outside: it is made printable.

    Rich sees finished text only, so no markup or emoji code in it has an effect.
    """

    def __init__(self, *, stderr: bool = False) -> None:
        self.console = Console(stderr=stderr, highlight=False, soft_wrap=True)

    def print(self, *lines: str, style: str = "", start: str = "") -> None:
        """Print each of the lines in ``style``; the first begins with ``start`` in bold red."""
        text = Text("\n").join(Text(printable(line), style) for line in lines)
        # On one terminal, the console that shows a bar must print, so that the lines go above the bar.
        console = err.console if self.console.is_terminal and err.console.is_terminal else self.console
        console.print(Text(start, "bold red") + text if start else text)


out = Printer()
err = Printer(stderr=True)


def with_name(name: object, message: str) -> str:
    """Return a message that begins with ``name``, unless the message contains the name already."""
    return message if str(name) in message else f"{name}: {message}"


def fail(message: str) -> None:
    """Print an error in one line."""
    err.print(message, start="error: ")


def say(message: str) -> None:
    """Print a line for people. It goes to standard error: standard output holds results only."""
    err.print(message)


def print_json(value: Any) -> None:
    """Print a value as one strict JSON document: a number that is not finite becomes null."""
    sys.stdout.write(json.dumps(_jsonable(value), indent=2, allow_nan=False) + "\n")


def _jsonable(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {_jsonable(str(key)): _jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int):
        return value
    if hasattr(value, "tolist"):
        return _jsonable(value.tolist())
    # JSON's escapes cannot hold a lone surrogate, which is how Python holds a byte that is not UTF-8.
    return str(value).encode("utf-8", "backslashreplace").decode()


def report(document: Any, *lines: str, as_json: bool) -> None:
    """Print the result of a command: with ``--json`` as a document, otherwise as lines."""
    if as_json:
        print_json(document)
    else:
        out.print(*lines)


def print_table(
    columns: Sequence[str], rows: Sequence[Sequence[str]], *, numeric: Sequence[str] = ()
) -> None:
    """Print rows of text as a table, with the columns named in ``numeric`` aligned to the right.

    Rich's own table takes 0.1 s for the catalogue, and cuts columns when it does not know the terminal.
    """
    table = [[printable(cell) for cell in row] for row in (columns, *rows)]
    widths = [max(map(len, cells)) for cells in zip(*table, strict=True)]
    align = [str.rjust if column in numeric else str.ljust for column in columns]
    lines = [
        "  ".join(place(cell, width) for place, cell, width in zip(align, row, widths, strict=True)).rstrip()
        for row in table
    ]
    out.print(lines[0], style="bold")
    if rows:
        out.print(*lines[1:])


def counted(count: int, noun: str) -> str:
    """Return a count in words: ``1 base``, ``3 bases``, ``1 policy``, ``2 policies``."""
    if count != 1:
        noun = noun[:-1] + "ies" if noun.endswith("y") else noun + "s"
    return f"{count} {noun}"


@contextmanager
def progress(description: str, total: int | None) -> Iterator[Callable[..., None]]:
    """Show a bar with an estimate on the error stream, and yield the function that advances it.

    The function advances the bar by one, or by the number that it is given. A total of None is unknown: the
    bar counts, without an estimate. A log gets a line a minute instead of the bar.
    """
    name = bars.TextColumn("{task.description}", markup=False)
    columns = (name, bars.BarColumn(), bars.MofNCompleteColumn())
    times = (bars.TimeElapsedColumn(), "left", bars.TimeRemainingColumn())
    disable = not err.console.is_terminal
    with bars.Progress(
        *columns, *times, console=err.console, disable=disable, speed_estimate_period=ESTIMATE_SECONDS
    ) as bar:
        bar.add_task(printable(description), total=total)
        [task] = bar.tasks
        written = time.monotonic()

        def advance(count: int = 1) -> None:
            nonlocal written
            bar.advance(task.id, count)
            if disable and time.monotonic() - written >= LINE_SECONDS:
                written = time.monotonic()
                left = task.time_remaining
                estimate = "" if left is None else f", {timedelta(seconds=round(left))} left"
                say(f"{description}: {task.completed:.0f} of {total or 'unknown'}{estimate}")

        yield advance
