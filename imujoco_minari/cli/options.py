"""The arguments and options that several commands share, with one name and one meaning each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from imujoco_minari.variants import CATEGORIES, ROBOTS

# What to work on.
VariantId = Annotated[str, typer.Argument(metavar="VARIANT", help="A variant id.")]
VariantIds = Annotated[list[str] | None, typer.Argument(metavar="VARIANT", help="Variant ids.")]
DatasetIds = Annotated[list[str], typer.Argument(metavar="ID", help="Dataset ids.")]
MaybeDatasetIds = Annotated[list[str] | None, typer.Argument(metavar="ID", help="Dataset ids.")]


# The filters. Their meaning is in `imujoco_minari.cli.selection`.
def _either(words: Sequence[str]) -> str:
    return f"{', '.join(words[:-1])} or {words[-1]}"


Robot = Annotated[
    str | None,
    typer.Option(
        "--robot",
        "-r",
        metavar="ROBOT",
        help=f"The variants of one robot: {', '.join(ROBOTS)}, or another that has a page.",
    ),
]
Category = Annotated[
    str | None,
    typer.Option(
        "--category", "-c", metavar="CATEGORY", help=f"The variants of one category: {_either(CATEGORIES)}."
    ),
]
Everything = Annotated[bool, typer.Option("--all", help="All variants of the catalogue.")]
WithBase = Annotated[
    bool, typer.Option("--with-base", help="Add the base robot of the variants that the filters choose.")
]
Tier = Annotated[str, typer.Option("--tier", "-t", metavar="TIER", help="The tier of the data.")]
Tiers = Annotated[
    list[str] | None,
    typer.Option("--tier", "-t", metavar="TIER", help="A tier; may be repeated. [default: expert]"),
]

# How to work.
Episodes = Annotated[
    int, typer.Option("--episodes", "-n", min=1, max=1_000_000, metavar="N", help="Number of episodes.")
]
Seed = Annotated[
    int, typer.Option("--seed", "-s", min=0, metavar="N", help="Seed of everything that is random.")
]
Columns = Annotated[
    str | None,
    typer.Option(
        "--columns", metavar="NAMES", help="The columns of the table, as in observation,action,reward,done."
    ),
]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=1, metavar="N", help="Number of processes.")]
Backend = Annotated[
    str | None,
    typer.Option(
        "--backend",
        metavar="NAME",
        help="Where the jobs run: loky (this machine) or ray (a running Ray cluster).",
    ),
]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Print the work and its estimated size and time, and do nothing.")
]
PolicyFile = Annotated[
    Path | None, typer.Option("--policy", metavar="FILE", help="A Stable-Baselines3 .zip or a .safetensors.")
]
Remote = Annotated[
    str | None,
    typer.Option("--remote", metavar="ADDRESS", help="hf://user or gcp://bucket. [default: $MINARI_REMOTE]"),
]
Token = Annotated[
    str | None,
    typer.Option("--token", metavar="TOKEN", help="Hugging Face token, or a service account's key file."),
]

# Results.
Output = Annotated[
    Path | None, typer.Option("--output", "-o", metavar="PATH", help="The file or folder to write.")
]
Force = Annotated[bool, typer.Option("--force", help="Replace what exists already.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON, for scripts.")]
