"""``imujoco export`` and ``imujoco preferences``: datasets as the files of other libraries."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from imujoco_minari.cli.app import app
from imujoco_minari.cli.options import AsJson, DatasetIds, Force, Output, Seed
from imujoco_minari.cli.printing import counted, out, print_json


@app.command("export")
def export_datasets(
    ids: DatasetIds,
    format: Annotated[
        str, typer.Option("--format", "-f", metavar="FORMAT", help="d4rl, di-engine, rlds, lerobot or npz.")
    ],
    output: Output = None,
    states_only: Annotated[
        bool, typer.Option("--states-only", help="Leave out actions and rewards.")
    ] = False,
    portion: Annotated[
        tuple[float, float],
        typer.Option(metavar="FROM TO", help="Share of each variant's episodes: from and to."),
    ] = (0.0, 1.0),
    seed: Seed = 0,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write datasets in the format of another library.

    The new file or folder is named after the first dataset unless --output names it.

    Examples: `imujoco export imujoco/hopper-base-v0 --format d4rl`,
    `imujoco export imujoco/hopper-all-v0 --format rlds --portion 0 0.75 -o train`
    """
    from imujoco_minari.exporting import default_target, export
    from imujoco_minari.loading import arrays

    target = output or default_target(ids[0], format, states_only=states_only)
    exported = export(
        arrays(ids, portion=portion, seed=seed), format, target, states_only=states_only, force=force
    )
    if as_json:
        print_json(vars(exported))
        return
    out.print(
        f"exported {counted(exported.episodes, 'episode')}, {counted(exported.steps, 'step')}, "
        f"as {exported.format}",
        f"  at {exported.path.resolve()}",
    )


@app.command()
def preferences(
    ids: DatasetIds,
    output: Output = None,
    pairs: Annotated[int, typer.Option("--pairs", "-n", min=1, metavar="N", help="Number of pairs.")] = 1000,
    length: Annotated[
        int, typer.Option("--length", "-l", min=1, metavar="N", help="Steps of a segment.")
    ] = 50,
    tiers: Annotated[
        str | None, typer.Option(metavar="TIERS", help="Tiers from best to worst, as expert,medium,random.")
    ] = None,
    seed: Seed = 0,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write pairs of segments, labelled with the better one.

    The better segment is the one of higher return, or of the better tier with --tiers.

    Example: `imujoco preferences imujoco/hopper-base-v0 imujoco/hopper-base-random-v0 --tiers expert,random`
    """
    from imujoco_minari.loading import arrays, preference_pairs

    target = output or Path(ids[0].rpartition("/")[2] + "-preferences.npz")
    ranked = tiers.split(",") if tiers else None
    chosen = preference_pairs(arrays(ids), pairs=pairs, length=length, tiers=ranked, seed=seed)
    chosen.save(target, force=force)
    if as_json:
        print_json({"path": target, "pairs": pairs, "length": length, "tiers": ranked, "seed": seed})
        return
    out.print(f"wrote {counted(pairs, 'pair')} of {length} steps", f"  at {target.resolve()}")
