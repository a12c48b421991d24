"""``imujoco export`` and ``imujoco preferences``: datasets as the files of other libraries."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from imujoco_minari.cli import options
from imujoco_minari.cli.app import app
from imujoco_minari.cli.estimates import export_line, plan_export
from imujoco_minari.cli.options import option, spread
from imujoco_minari.cli.printing import counted, print_json, progress, report, say
from imujoco_minari.cli.selection import DatasetChoice
from imujoco_minari.errors import DatasetError, VariantError
from imujoco_minari.storage import minari_root
from imujoco_minari.storage.missing import not_in_root

_WHOLE = (0.0, 1.0)


@app.command("export")
@spread
def export_datasets(
    format: Annotated[str, option("--format -f FORMAT", "d4rl, di-engine, rlds, lerobot, npz or imujoco.")],
    choice: DatasetChoice,
    output: options.Output = None,
    states_only: Annotated[bool, option("--states-only", "Leave out actions and rewards.")] = False,
    portion: Annotated[
        tuple[float, float], option("--portion FROM TO", "Share of each variant's episodes: from and to.")
    ] = _WHOLE,
    seed: options.Seed = 0,
    force: options.Force = False,
    dry_run: options.DryRun = False,
    as_json: options.AsJson = False,
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

    chosen = choice.datasets(published=False)
    missing = [dataset_id for dataset_id in chosen if not minari_root.exists(dataset_id)]
    if missing:
        raise choice.not_published(len(missing), len(chosen)) if choice else not_in_root(missing[0])
    if output is None and (choice or format == ARCHIVE):
        raise VariantError("name the new file or folder with --output")
    if format == ARCHIVE and (states_only or portion != _WHOLE):
        raise DatasetError(f"the format {ARCHIVE} has whole datasets: leave out --states-only and --portion")
    target = output or default_target(chosen[0], format, states_only=states_only)
    if dry_run or len(chosen) > 1:
        planned = plan_export(chosen, archive=format == ARCHIVE)
        say(export_line(planned))
        if dry_run:
            if as_json:
                print_json(planned)
            return
    if format == ARCHIVE:
        with progress("exporting", len(chosen)) as advance:
            exported = export_archive(chosen, target, force=force, on_dataset=advance)
    else:
        data = arrays(chosen, portion=portion, seed=seed)
        exported = export(data, format, target, states_only=states_only, force=force)
    counts = f"{counted(exported.episodes, 'episode')}, {counted(exported.steps, 'step')}"
    line = f"exported {counts}, as {exported.format}"
    report(vars(exported), line, f"  at {exported.path.resolve()}", as_json=as_json)


@app.command()
def preferences(
    ids: options.DatasetIds,
    output: options.Output = None,
    pairs: Annotated[int, option("--pairs -n N", "Number of pairs.", min=1)] = 1000,
    length: Annotated[int, option("--length -l N", "Steps of a segment.", min=1)] = 50,
    tiers: Annotated[str | None, option("--tiers TIERS", "Tiers, best first: expert,medium,random.")] = None,
    seed: options.Seed = 0,
    force: options.Force = False,
    as_json: options.AsJson = False,
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
    document = {"path": target, "pairs": pairs, "length": length, "tiers": ranked, "seed": seed}
    lines = f"wrote {counted(pairs, 'pair')} of {length} steps", f"  at {target.resolve()}"
    report(document, *lines, as_json=as_json)
