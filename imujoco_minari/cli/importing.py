"""``imujoco import-archive``, ``diff-catalogue`` and ``import``: the original's archive, and others' data."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from imujoco_minari.cli import options
from imujoco_minari.cli.app import FAILED, advancing, app, gather
from imujoco_minari.cli.datasets import describe_published
from imujoco_minari.cli.options import argument, option
from imujoco_minari.cli.printing import counted, out, print_json, print_table, say, with_name
from imujoco_minari.errors import DatasetNotFoundError
from imujoco_minari.variants import Variant

if TYPE_CHECKING:
    from imujoco_minari.envs.differences import Difference
    from imujoco_minari.importing.catalogue_diff import Departure


@app.command("import-archive")
def import_archive_command(
    place: Annotated[Path, argument("DIR", "Folder with xml, policies and dataset.")],
    variants: options.VariantIds = None,
    robot: options.Robot = None,
    category: options.Category = None,
    recollect: Annotated[bool, option("--recollect", "Run the archive's policies in its models.")] = False,
    episodes: options.EpisodeCount = 100,
    seed: options.Seed = 0,
    columns: options.Columns = None,
    force: options.Force = False,
    as_json: options.AsJson = False,
) -> None:
    """Publish the original's archive.

    The dataset ids are imujoco-original/<variant>-v0. DIR holds the folders xml, policies and dataset, or
    their zips. Without ids and filters, it publishes the whole archive. The columns of the tables are
    detected and checked; --columns states them instead. With --recollect, the archive's policies make
    --episodes new episodes, as the tier recollected.

    Examples: `imujoco import-archive imujoco/`,
    `imujoco import-archive imujoco/ hopper-massdec_25_leggeom --recollect`
    """
    from imujoco_minari.importing.archive import open_archive
    from imujoco_minari.importing.originals import Import, import_archive

    archive = open_archive(place)
    chosen = archive.select(variants or [], robot, category)
    how = Import(columns, recollect, episodes, seed, force)
    if archive.ignored:
        shown = ", ".join(archive.ignored[:5])
        say(f"left out {counted(len(archive.ignored), 'file')} not named after a variant: {shown}")
    outcomes = advancing(import_archive(archive, chosen, how), "importing", len(chosen))
    gather(outcomes, describe_published, as_json=as_json)


@app.command("diff-catalogue")
def diff_catalogue(
    place: Annotated[Path | None, argument("DIR", "The archive. [default: the imported datasets]")] = None,
    robot: options.Robot = None,
    category: options.Category = None,
    as_json: options.AsJson = False,
) -> None:
    """Compare the original's models with ours.

    It shows the physical quantities that differ. A variant that our catalogue does not have is compared
    with the base robot.

    Examples: `imujoco diff-catalogue imujoco/`, `imujoco diff-catalogue --robot hopper`
    """
    from imujoco_minari.importing import catalogue_diff
    from imujoco_minari.importing.archive import of_kind, open_archive

    if place is not None:
        archive = open_archive(place)
        found = of_kind((v for v in archive.variants if "xml" in archive.files[v]), robot, category)
        departures = list(catalogue_diff.departures_of_archive(archive, found))
    else:
        models = catalogue_diff.published_models()
        found = of_kind(models, robot, category)
        if not found:
            raise DatasetNotFoundError(
                "no dataset of the original is published here: give the archive's folder, "
                "or import it with `imujoco import-archive DIR`"
            )
        departures = [catalogue_diff.departure(variant, models[variant]) for variant in found]
    shared = catalogue_diff.coverage(found, robot, category)
    if as_json:
        shown = [vars(each) | {"differences": list(map(vars, each.differences))} for each in departures]
        print_json({"departures": shown, "coverage": vars(shared)})
    else:
        _print_departures(departures)
        out.print(
            f"ids: {len(shared.both)} in both catalogues, {len(shared.only_original)} only in the "
            f"original's, {len(shared.only_ours)} only in ours"
        )
    if any(departure.error for departure in departures):
        raise typer.Exit(FAILED)


@app.command("import")
def import_command(
    source: Annotated[str, argument("SOURCE", "A Minari id or folder, a D4RL HDF5 file, or an .npz.")],
    variant: Annotated[str, option("--variant VARIANT", "The variant that the data are of.")],
    tier: Annotated[str, option("--tier -t TIER", "The tier to publish them as.")],
    columns: options.Columns = None,
    force: options.Force = False,
    as_json: options.AsJson = False,
) -> None:
    """Publish external data as a tier of a variant.

    Examples: `imujoco import mujoco/hopper/expert-v0 --variant hopper-base --tier farama`,
    `imujoco import hopper_medium-v2.hdf5 --variant hopper-base --tier d4rl-medium`
    """
    from imujoco_minari.importing.external import import_dataset

    imported = import_dataset(source, Variant.parse(variant), tier, columns=columns, force=force)
    near = imported.one_step
    if as_json:
        print_json(vars(imported.published) | {"one_step_difference": vars(near), "notes": imported.notes})
        return
    gather([imported.published], describe_published, as_json=False)
    if not imported.published.created:
        return
    for note in imported.notes:
        say(note)
    if near.rows:
        out.print(
            f"  {near.rows} of its steps, simulated again in {variant}, end elsewhere by "
            f"{near.position_median:.2g} (m, rad) and {near.velocity_median:.2g} (m/s, rad/s) in the median, "
            f"{near.position_max:.2g} and {near.velocity_max:.2g} at most"
        )


def _print_departures(departures: list[Departure]) -> None:
    from imujoco_minari.importing.catalogue_diff import common_differences

    common = common_differences(departures)
    for robot, shared in common.items():
        out.print(f"{robot}, in most variants", style="bold")
        _print_differences(list(shared))
    for departure in departures:
        shared = common.get(departure.variant.partition("-")[0], {})
        own = [difference for difference in departure.differences if difference not in shared]
        if departure.error:
            say(with_name(departure.variant, departure.error))
        elif own or not departure.same_id:
            against = "" if departure.same_id else f", which our catalogue lacks, against {departure.against}"
            out.print(f"{departure.variant}{against}", style="bold")
            _print_differences(own)
    same = sum(not departure.differences and not departure.error for departure in departures)
    failed = sum(bool(departure.error) for departure in departures)
    out.print(
        f"models: {len(departures)} compared, {same} as ours, "
        f"{len(departures) - same - failed} different, {failed} unreadable"
    )


def _print_differences(differences: list[Difference]) -> None:
    rows = [[f"  {d.quantity}", f"{d.before:.6g}", f"{d.after:.6g}", d.unit] for d in differences]
    if rows:
        print_table(("  quantity", "ours", "original", "unit"), rows, numeric=("ours", "original"))
    out.print("")
