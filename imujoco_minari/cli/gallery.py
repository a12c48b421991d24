"""``imujoco gallery``: a static website of the variants."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from imujoco_minari.cli import options
from imujoco_minari.cli.app import FAILED, app
from imujoco_minari.cli.estimates import gallery_line, size_text
from imujoco_minari.cli.options import argument, option
from imujoco_minari.cli.printing import fail, progress, report, say, with_name
from imujoco_minari.cli.selection import VariantChoice


@app.command()
def gallery(
    folder: Annotated[Path, argument("FOLDER", "Folder of the site.")],
    variants: options.VariantIds = None,
    robot: options.Robot = None,
    category: options.Category = None,
    results: Annotated[
        Path | None, option("--results FOLDER", "Show the few-shot scores of this folder's results.")
    ] = None,
    as_json: options.AsJson = False,
) -> None:
    """Build a static website of the variants.

    It shows clips, numbers, returns and code. Without ids and filters, it shows the whole catalogue. The
    base robots are always shown too, for comparison. The site works from a folder and from any web host. A
    second run in the same folder draws only what is new or has changed, so an interrupted run can be
    continued.

    Examples: `imujoco gallery site`, `imujoco gallery site --robot hopper --category length`,
    `imujoco gallery site --results results`
    """
    from imujoco_minari.benchmark.page import read_results
    from imujoco_minari.benchmark.tables import variant_tables
    from imujoco_minari.pictures.gallery.builder import build, steps

    start = time.monotonic()
    tables = variant_tables(read_results(results).few_shot) if results else {}
    everything = not (variants or robot or category)
    chosen = VariantChoice(robot, category, everything, names=variants).variants()
    count = steps(folder, chosen)
    if not as_json and len(chosen) > 1:
        say(gallery_line(count))
    with progress("drawing", count, quiet=as_json) as advance:
        built = build(folder, chosen, results=tables, on_variant=advance)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    result = {
        "index": str(folder / "index.html"),
        "variants": built.variants,
        "drawn": built.drawn,
        "failed": built.failed,
        "bytes": size,
        "seconds": time.monotonic() - start,
    }
    line = (
        f"wrote {result['index']}: {built.variants} variants and bases, {built.drawn} drawn anew, "
        f"{size_text(size)}, in {result['seconds']:.0f} s"
    )
    report(result, line, as_json=as_json)
    for variant, reason in built.failed.items():
        fail(with_name(variant, reason))
    if built.failed:
        raise typer.Exit(FAILED)
