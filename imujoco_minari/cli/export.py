"""``imujoco export`` and ``imujoco preferences``: datasets as the files of other libraries."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from imujoco_minari.cli.app import AsJson, app, out, print_json

Ids = Annotated[list[str], typer.Argument(help="Dataset ids.")]
Output = Annotated[Path | None, typer.Option("--output", "-o", help="The file or folder to make.")]
Force = Annotated[bool, typer.Option("--force", help="Replace an earlier export, and nothing else.")]
Seed = Annotated[int, typer.Option("--seed", "-s", min=0, help="Seed of what is drawn.")]


@app.command("export")
def export_datasets(
    ids: Ids,
    format: Annotated[str, typer.Option("--format", "-f", help="d4rl, di-engine, rlds, lerobot or npz.")],
    output: Output = None,
    states_only: Annotated[
        bool, typer.Option("--states-only", help="Leave actions and rewards out.")
    ] = False,
    portion: Annotated[
        tuple[float, float], typer.Option(help="Share of each variant's episodes, from and to.")
    ] = (0.0, 1.0),
    seed: Seed = 0,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write datasets as a file or folder that another library reads.

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
        f"exported {exported.episodes} episodes, {exported.steps} steps, as {exported.format}\n"
        f"  at {exported.path.resolve()}"
    )


@app.command()
def preferences(
    ids: Ids,
    output: Output = None,
    pairs: Annotated[int, typer.Option("--pairs", "-n", min=1, help="How many pairs.")] = 1000,
    length: Annotated[int, typer.Option("--length", "-l", min=1, help="Steps of a stretch.")] = 50,
    tiers: Annotated[
        str | None, typer.Option(help="Tiers from best to worst, as expert,medium,random.")
    ] = None,
    seed: Seed = 0,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write pairs of stretches, and which of them is preferred: by return, or by tier.

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
    out.print(f"wrote {pairs} pairs of {length} steps\n  at {target.resolve()}")
