"""The arguments and options that several commands share, with one name and one meaning each."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer

from imujoco_minari.variants import CATEGORIES, ROBOTS


def option(form: str, help: str, **limits: Any) -> Any:
    """Return an option.

    Args:
        form: its names and the word for its value, as the help shows them: ``--jobs -j N``.
        help: its line of help.
        limits: further arguments of ``typer.Option``, such as ``min``.
    """
    words = form.split()
    names = [word for word in words if word.startswith("-")]
    return typer.Option(*names, metavar=" ".join(words[len(names) :]) or None, help=help, **limits)


def argument(metavar: str, help: str) -> Any:
    """Return an argument with the word that stands for it in the help."""
    return typer.Argument(metavar=metavar, help=help)


def spread(command: Callable[..., None]) -> Callable[..., None]:
    """Make each parameter of a command that is a dataclass appear as options: the fields of the class."""
    signature = inspect.signature(command, eval_str=True)
    groups: dict[str, Any] = {}
    shown: list[inspect.Parameter] = []
    for name, each in signature.parameters.items():
        own = [each]
        if is_dataclass(each.annotation):
            groups[name] = each.annotation
            own = list(inspect.signature(groups[name], eval_str=True).parameters.values())
        shown += [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in own]

    @wraps(command)
    def spread_command(**given: Any) -> None:
        for name, group in groups.items():
            given[name] = group(**{field.name: given.pop(field.name) for field in fields(group)})
        command(**given)

    # Typer reads both.
    spread_command.__signature__ = signature.replace(parameters=shown)  # type: ignore[attr-defined]
    spread_command.__annotations__ = {each.name: each.annotation for each in shown}
    return spread_command


# What to work on.
VariantId = Annotated[str, argument("VARIANT", "A variant id.")]
VariantIds = Annotated[list[str] | None, argument("VARIANT", "Variant ids.")]
DatasetIds = Annotated[list[str], argument("ID", "Dataset ids.")]
MaybeDatasetIds = Annotated[list[str] | None, argument("ID", "Dataset ids.")]

# The filters. Their meaning is in `imujoco_minari.cli.selection`.
_ROBOTS = f"The variants of one robot: {', '.join(ROBOTS)}, or another that has a page."
_CATEGORIES = f"The variants of one category: {', '.join(CATEGORIES[:-1])} or {CATEGORIES[-1]}."
_WITH_BASE = "Add the base robot of the variants that the filters choose."
Robot = Annotated[str | None, option("--robot -r ROBOT", _ROBOTS)]
Category = Annotated[str | None, option("--category -c CATEGORY", _CATEGORIES)]
Everything = Annotated[bool, option("--all", "All variants of the catalogue.")]
WithBase = Annotated[bool, option("--with-base", _WITH_BASE)]
Tier = Annotated[str, option("--tier -t TIER", "The tier of the data.")]
Tiers = Annotated[list[str] | None, option("--tier -t TIER", "A tier; may be repeated. [default: expert]")]

# How to work.
EpisodeCount = Annotated[int, option("--episodes -n N", "Number of episodes.", min=1, max=1_000_000)]
Seed = Annotated[int, option("--seed -s N", "Seed of everything that is random.", min=0)]
Columns = Annotated[str | None, option("--columns NAMES", "Columns, as in observation,action,reward,done.")]
Jobs = Annotated[int, option("--jobs -j N", "Number of processes.", min=1)]
Backend = Annotated[str | None, option("--backend NAME", "Where jobs run: loky (here) or ray (a cluster).")]
DryRun = Annotated[bool, option("--dry-run", "Print the work and its estimated cost, and do nothing.")]
PolicyFile = Annotated[Path | None, option("--policy FILE", "A Stable-Baselines3 .zip or a .safetensors.")]
Remote = Annotated[
    str | None, option("--remote ADDRESS", "hf://user or gcp://bucket. [default: $MINARI_REMOTE]")
]
Token = Annotated[str | None, option("--token TOKEN", "Hugging Face token, or a service account's key file.")]

# Results.
Output = Annotated[Path | None, option("--output -o PATH", "The file or folder to write.")]
Force = Annotated[bool, option("--force", "Replace what exists already.")]
AsJson = Annotated[bool, option("--json", "Print JSON, for scripts.")]
