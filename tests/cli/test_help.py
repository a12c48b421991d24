"""The help: nothing of a text is lost, every command has examples that work, an option has one name."""

from __future__ import annotations

import inspect
import shlex
from collections import defaultdict
from typing import Any

import pytest
import typer

import imujoco_minari.cli  # noqa: F401
from imujoco_minari.cli.app import app, command, run


def commands() -> dict[str, Any]:
    """Return every command by its whole name, as Typer makes it."""
    root: Any = typer.main.get_command(app)
    groups = {name: each for name, each in root.commands.items() if hasattr(each, "commands")}
    inner = {
        f"{name} {part}": each for name, group in groups.items() for part, each in group.commands.items()
    }
    return {name: each for name, each in root.commands.items() if name not in groups} | inner


COMMANDS = commands()


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_shows_the_whole_docstring(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([*name.split(), "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    text = inspect.cleandoc(COMMANDS[name].callback.__doc__ or "")
    prose, _, examples = text.partition("\n\nExample")
    assert " ".join(prose.split()) in shown
    for example in examples.split("`")[1::2]:
        assert " ".join(example.split()) in shown
    for parameter in COMMANDS[name].params:
        assert " ".join((parameter.help or "").split()) in shown


def test_angle_brackets_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    run(["import-archive", "--help"])
    assert "imujoco-original/<variant>-v0" in capsys.readouterr().out
    run(["transfer", "--help"])
    assert "`transfer-<robot>`" in capsys.readouterr().out


@pytest.mark.parametrize("name", COMMANDS)
def test_the_examples_can_be_given_as_they_are(name: str) -> None:
    root: Any = command()
    found: Any = root
    for part in name.split():
        found = found.commands[part]
    examples = [line.strip() for line in (found.epilog or "").splitlines() if line.startswith("  ")]
    assert examples
    for example in examples:
        words = shlex.split(example)
        assert words[: 1 + len(name.split())] == ["imujoco", *name.split()]
        # It parses the arguments and runs nothing.
        found.make_context(name, words[1 + len(name.split()) :])


def test_an_option_has_one_name_and_one_meaning() -> None:
    meanings: dict[str, set[str]] = defaultdict(set)
    names: dict[str, set[tuple[str, ...]]] = defaultdict(set)
    for each in COMMANDS.values():
        for parameter in each.params:
            for option in parameter.opts if parameter.param_type_name == "option" else ():
                meanings[option].add(parameter.help or "")
                names[option].add(tuple(parameter.opts))
    assert {option for option, spellings in names.items() if len(spellings) > 1} <= {
        # Their short names mean something else in the one command that has them.
        "-n",
    }
    assert {option for option, texts in meanings.items() if len(texts) > 1} <= {
        # The tier that is read, made or given, one or several.
        *("--tier", "-t"),
        # `transfer` takes several policies, and `delete` forces something else.
        *("--policy", "--force"),
        # Episodes or pairs.
        "-n",
        "--help",
    }
    assert "--out" not in names
    assert names["-o"] == {("--output", "-o")}


def test_no_command_shows_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert run([]) == 0
    assert "Commands:" in capsys.readouterr().out
    assert run(["policy"]) == 2
    assert "error: Missing command" in capsys.readouterr().err


def test_the_summary_of_a_command_is_whole(capsys: pytest.CaptureFixture[str]) -> None:
    run(["--help"])
    assert "..." not in capsys.readouterr().out.partition("Commands:")[2]
