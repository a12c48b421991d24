"""``imujoco gallery``: a static website of the variants."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from imujoco_minari.cli.app import AsJson, Category, Robot, app, fail, out, print_json, progress
from imujoco_minari.cli.datasets import select


@app.command()
def gallery(
    folder: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the site.")],
    variants: Annotated[list[str] | None, typer.Argument(help="Variant ids; all 154 without any.")] = None,
    robot: Robot = None,
    category: Category = None,
    as_json: AsJson = False,
) -> None:
    """Build a static website of the variants, with clips, numbers, returns and code.

    Works from a folder and from any web host. A folder that has a gallery keeps what it has: only
    what is new or has changed is drawn, so a run that was broken off goes on.

    Examples: `imujoco gallery site`, `imujoco gallery site --robot hopper --category length`
    """
    from imujoco_minari.pictures.gallery.builder import build, steps

    start = time.monotonic()
    chosen = select(variants or [], robot, category, everything=not (robot or category))
    with progress("drawing", steps(folder, chosen), quiet=as_json) as advance:
        built = build(folder, chosen, on_variant=advance)
    files = [path for path in folder.rglob("*") if path.is_file()]
    told = {
        "index": str(folder / "index.html"),
        "variants": built.variants,
        "drawn": built.drawn,
        "failed": built.failed,
        "bytes": sum(path.stat().st_size for path in files),
        "seconds": time.monotonic() - start,
    }
    if as_json:
        print_json(told)
    else:
        out.print(
            f"wrote {told['index']}: {built.variants} variants and bases, {built.drawn} drawn anew, "
            f"{sum(path.stat().st_size for path in files) / 1e6:.1f} MB, in {time.monotonic() - start:.0f} s"
        )
    for variant, reason in built.failed.items():
        fail(f"{variant}: {reason}")
    if built.failed:
        raise typer.Exit(1)
