"""``imujoco export`` and ``imujoco preferences``: datasets as the files of other libraries."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from imujoco_minari.cli.app import app
from imujoco_minari.cli.estimates import plan_export
from imujoco_minari.cli.options import (
    AsJson,
    Category,
    DatasetIds,
    DryRun,
    Everything,
    Force,
    MaybeDatasetIds,
    Output,
    Robot,
    Seed,
    Tiers,
    WithBase,
)
from imujoco_minari.cli.printing import counted, out, print_json, progress, say
from imujoco_minari.cli.selection import Filters, not_published, select_datasets
from imujoco_minari.errors import DatasetError, VariantError
from imujoco_minari.storage import minari_root
from imujoco_minari.storage.missing import not_in_root

_WHOLE = (0.0, 1.0)


@app.command("export")
def export_datasets(
    format: Annotated[
        str,
        typer.Option(
            "--format", "-f", metavar="FORMAT", help="d4rl, di-engine, rlds, lerobot, npz or imujoco."
        ),
    ],
    ids: MaybeDatasetIds = None,
    robot: Robot = None,
    category: Category = None,
    everything: Everything = False,
    with_base: WithBase = False,
    tiers: Tiers = None,
    output: Output = None,
    states_only: Annotated[
        bool, typer.Option("--states-only", help="Leave out actions and rewards.")
    ] = False,
    portion: Annotated[
        tuple[float, float],
        typer.Option(metavar="FROM TO", help="Share of each variant's episodes: from and to."),
    ] = _WHOLE,
    seed: Seed = 0,
    force: Force = False,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Write datasets in the format of another library.

    The new file or folder is named after the first dataset unless --output names it. With filters, all
    datasets of the chosen variants must be in the Minari root.

    The format imujoco is the archive of the original benchmark: a folder with the datasets, policies and
    models of the variants. It takes variants of all robots, each with all its episodes.

    Examples: `imujoco export imujoco/hopper-base-v0 --format d4rl`,
    `imujoco export imujoco/hopper-all-v0 --format rlds --portion 0 0.75 -o train`,
    `imujoco export --format imujoco --robot halfcheetah -o imujoco`
    """
    from imujoco_minari.exporting import ARCHIVE, default_target, export, export_archive
    from imujoco_minari.loading import arrays

    filters = Filters(robot, category, everything, with_base)
    chosen = select_datasets(ids, filters, tiers, published=False)
    missing = [dataset_id for dataset_id in chosen if not minari_root.exists(dataset_id)]
    if missing:
        raise not_published(missing, chosen, filters, tiers) if filters else not_in_root(missing[0])
    if output is None and (filters or format == ARCHIVE):
        raise VariantError("name the new file or folder with --output")
    if format == ARCHIVE and (states_only or portion != _WHOLE):
        raise DatasetError(f"the format {ARCHIVE} has whole datasets: leave out --states-only and --portion")
    target = output or default_target(chosen[0], format, states_only=states_only)
    if dry_run or len(chosen) > 1:
        planned = plan_export(chosen, archive=format == ARCHIVE)
        if dry_run and as_json:
            print_json(vars(planned))
        else:
            say(str(planned))
        if dry_run:
            return
    if format == ARCHIVE:
        with progress("exporting", len(chosen), quiet=as_json) as advance:
            exported = export_archive(chosen, target, force=force, on_dataset=advance)
    else:
        data = arrays(chosen, portion=portion, seed=seed)
        exported = export(data, format, target, states_only=states_only, force=force)
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
