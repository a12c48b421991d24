"""``imujoco benchmark``: compute results of methods, and show them as tables and a page."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from itertools import chain, groupby
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from imujoco_minari.cli.app import FAILED, advancing, app
from imujoco_minari.cli.estimates import plan, publishing_line, time_text
from imujoco_minari.cli.options import AsJson, DryRun, Jobs, Output, Tiers, argument, option
from imujoco_minari.cli.printing import counted, out, print_json, print_table, progress, report, say
from imujoco_minari.errors import BenchmarkError, DatasetNotFoundError
from imujoco_minari.variants import EXPERT, ROBOTS, held_out, parse_dataset_id

if TYPE_CHECKING:
    from imujoco_minari.benchmark.few_shot import FewShotGrid
    from imujoco_minari.benchmark.lines import Line
    from imujoco_minari.benchmark.offline import OfflineGrid
    from imujoco_minari.benchmark.reproduction import Comparison
    from imujoco_minari.benchmark.scores import MethodScore
    from imujoco_minari.publishing.recipes import Recipe

benchmark = typer.Typer(help="Compute and show results of methods.")
app.add_typer(benchmark, name="benchmark")

RESULTS = Path("results")
_COLUMNS = ("method", "steps", "data", "score", "low", "high", "error", "variants", "seeds")
_ERROR_COLUMNS = ("method", "windows", "steps", "error", "std", "published")

Folder = Annotated[Path, argument("FOLDER", "The folder of result lines.")]
Methods = Annotated[list[str] | None, option("--method -m NAME", "A method; may be repeated.")]
Seeds = Annotated[int | None, option("--seeds N", "Number of seeds. [default: the protocol's]", min=1)]


@benchmark.command("few-shot")
def few_shot(
    splits: Annotated[list[str] | None, option("--split NAME", "A split; may be repeated.")] = None,
    methods: Methods = None,
    variants: Annotated[list[str] | None, option("--held-out VARIANT", "A variant; may be repeated.")] = None,
    tiers: Tiers = None,
    budgets: Annotated[list[str] | None, option("--budget NAME", "Windows and steps, as in 5x100.")] = None,
    seeds: Seeds = None,
    settings: Annotated[
        list[str] | None, option("--setting NAME=VALUE", "A setting of the methods; may be repeated.")
    ] = None,
    demonstrations: Annotated[
        str | None,
        option("--demonstrations TIER", "Another tier of the demonstrations, as of other experts."),
    ] = None,
    validation: Annotated[bool, option("--validation", "Hold out every fifth training variant.")] = False,
    jobs: Jobs = 1,
    output: Output = None,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Run few-shot imitation.

    Each method learns from the training variants of a split, adapts to demonstrations of a held-out variant,
    and is evaluated on it. Each cell becomes a line of few-shot.jsonl in the folder `results`, unless
    --output names another. A killed run continues where it stopped, and a finished cell is never computed
    again while its data, policies, settings and versions are the same. Datasets that are missing are
    published first. Without options, it runs all cells of few-shot-v1 with the tier expert, which takes
    hours. --held-out without --split takes the first split that holds the variant out, the extremes first.
    --method takes your own class as <module>:<Class>. --demonstrations takes any tier that is in the Minari
    root, so `imujoco publish VARIANT --tier other --policy FILE` adds demonstrators of your own. To choose
    settings, use --setting with --validation, which evaluates on training variants alone.

    Examples: `imujoco benchmark few-shot --split hopper-random-v1 --jobs 2`,
    `imujoco benchmark few-shot -m scratch --held-out hopper-frictiondec_50_feet --budget 5x100 --seeds 1`
    """
    from imujoco_minari.benchmark.few_shot import FewShotGrid, run_few_shot
    from imujoco_minari.benchmark.methods import BOUNDS, METHODS, find_method, with_settings
    from imujoco_minari.benchmark.protocol import SEEDS, Budget, holding_out, validation_split
    from imujoco_minari.benchmark.scores import few_shot_scores

    # A method of your own is imported from the current folder.
    sys.path.insert(0, str(Path.cwd()))
    names = splits or [f"{robot}-{kind}-v1" for robot in ROBOTS for kind in ("extremes", "random")]
    chosen = [held_out(name) for name in names]
    if validation:
        chosen = [validation_split(split) for split in chosen]
    if variants and not splits:
        chosen = holding_out(variants, chosen)
    grid = FewShotGrid(
        {name: with_settings(find_method(name), settings or ()) for name in methods or METHODS},
        chosen,
        tiers or [EXPERT],
        [Budget.parse(budget) for budget in budgets] if budgets else None,
        range(seeds or SEEDS),
        variants,
        demonstrations=demonstrations,
    )
    recipes = _recipes(grid.dataset_ids())
    _say_cost(grid, recipes, jobs, dry_run=dry_run, as_json=as_json)
    trains = bool(set(grid.methods) & (METHODS.keys() - BOUNDS))
    _publish(recipes, jobs, trains=trains)
    with progress("computing", grid.cells()) as on_cells:
        lines = run_few_shot(grid, output or RESULTS, jobs=jobs, on_cells=on_cells)
    _show(few_shot_scores(lines), as_json)


@benchmark.command()
def offline(
    methods: Methods = None,
    robots: Annotated[list[str] | None, option("--base ROBOT", "A base robot; may be repeated.")] = None,
    tiers: Annotated[list[str] | None, option("--tier -t TIER", "A tier; may be repeated.")] = None,
    seeds: Seeds = None,
    updates: Annotated[int | None, option("--updates N", "Number of gradient steps.", min=1)] = None,
    jobs: Jobs = 1,
    output: Output = None,
    dry_run: DryRun = False,
    across: Annotated[bool, option("--across", "Learn from all training variants of a split.")] = False,
    as_json: AsJson = False,
) -> None:
    """Run offline reinforcement learning on the bases' datasets, or across variants.

    Each algorithm learns from a dataset and is evaluated on the base robot; after medium-expert data also
    on four variants. It is evaluated after 25,000, 50,000, 100,000 and 250,000 updates; with --updates, after
    those that are fewer, and at the end. Each cell becomes a line of offline.jsonl in the folder `results`,
    unless --output names another. A killed run continues where it stopped. Datasets that are missing are
    published first. --across learns from the medium-expert data of all training variants of the random
    split, and is evaluated on those held out; its lines are in across.jsonl. --method takes your own class
    as <module>:<Class>.

    Example: `imujoco benchmark offline --method td3+bc --base hopper --tier medium-expert --seeds 1`
    """
    from imujoco_minari.benchmark.methods import find_method
    from imujoco_minari.benchmark.offline import (
        ACROSS_ALGORITHMS,
        ALGORITHMS,
        SEEDS,
        SHIFTED_TIER,
        TIERS,
        UPDATES,
        OfflineGrid,
        run_offline,
    )
    from imujoco_minari.benchmark.scores import offline_scores

    sys.path.insert(0, str(Path.cwd()))
    known = ACROSS_ALGORITHMS if across else ALGORITHMS
    grid = OfflineGrid(
        {name: find_method(name, known, "train(arrays)") for name in methods or known},
        robots or ROBOTS,
        tiers or ([SHIFTED_TIER] if across else TIERS),
        range(seeds or SEEDS),
        updates or UPDATES,
        across=across,
    )
    _say_cost(grid, grid.recipes(), jobs, dry_run=dry_run, as_json=as_json)
    _publish(grid.recipes(), jobs)
    with progress("training", grid.cells()) as on_cells:
        lines = run_offline(grid, output or RESULTS, jobs=jobs, on_cells=on_cells)
    _show(offline_scores(lines), as_json)


@benchmark.command()
def reproduce(seeds: Seeds = None, jobs: Jobs = 1, output: Output = None, as_json: AsJson = False) -> None:
    """Repeat the published comparison of MAML and fine-tuning on HalfCheetah.

    It prints the relative errors of the actions beside the published ones. Each method and seed becomes a
    line of reproduction.jsonl in the folder `results`, unless --output names another. It takes about 25
    minutes of one core for each seed.

    Example: `imujoco benchmark reproduce --jobs 2`
    """
    from imujoco_minari.benchmark import reproduction

    chosen = range(seeds or reproduction.SEEDS)
    train, test = reproduction.published_split()
    _publish(_recipes([*train, *test]), jobs)
    with progress("training", len(chosen) * len(reproduction.METHODS)) as on_cells:
        lines = reproduction.run_reproduction(output or RESULTS, seeds=chosen, jobs=jobs, on_cells=on_cells)
    rows = reproduction.comparison(lines)
    if as_json:
        print_json([row._asdict() for row in rows])
    else:
        _show_comparison(rows)


@benchmark.command()
def table(folder: Folder = RESULTS, output: Output = None, as_json: AsJson = False) -> None:
    """Compute every score from result lines, and print them.

    The errors of the published comparison follow, if FOLDER has its lines. --output writes the scores as CSV
    too. The command lists the lines that do not match the published datasets, policies and settings, because
    one of them has changed since.

    Example: `imujoco benchmark table results --output scores.csv`
    """
    from imujoco_minari.benchmark.page import read_results
    from imujoco_minari.benchmark.reproduction import comparison
    from imujoco_minari.benchmark.scores import to_csv
    from imujoco_minari.storage.files import write_text

    results = read_results(folder)
    scores, rows = list(chain(*results.scores)), comparison(results.reproduction)
    if output is not None:
        write_text(output, to_csv(scores))
    if as_json:
        print_json({"scores": list(map(vars, scores)), "comparison": [row._asdict() for row in rows]})
    else:
        _show(scores)
        if rows:
            _show_comparison(rows)
    _say_changed(results.all())


@benchmark.command()
def page(folder: Folder = RESULTS, output: Output = None, as_json: AsJson = False) -> None:
    """Write the results page: Markdown, CSV and figures, all computed from result lines.

    It writes results.md, results.csv and the folder results-figures into the folder `docs`, unless --output
    names another. The text of findings.md in FOLDER, if it exists, begins the page.

    Example: `imujoco benchmark page results --output docs`
    """
    from imujoco_minari.benchmark.page import read_results, results_page, sections
    from imujoco_minari.benchmark.scores import to_csv
    from imujoco_minari.pictures.plotting.scores import plot_scores
    from imujoco_minari.storage.files import write_text

    results = read_results(folder)
    parts = sections(results)
    target = output or Path("docs")
    files: list[Path] = []
    for figure in chain.from_iterable(part.figures for part in parts):
        labels = (figure.title, figure.x_label, figure.y_label)
        stem = target / "results-figures" / figure.name
        files += plot_scores(figure.panels, figure.ticks, labels, stem, figure.reference)
    findings = folder / "findings.md"
    found = findings.read_text("utf-8") if findings.exists() else ""
    write_text(target / "results.md", results_page(results, parts, found))
    write_text(target / "results.csv", to_csv(chain(*results.scores)))
    files += [target / "results.md", target / "results.csv"]
    _say_changed(results.all())
    report({"files": files}, f"wrote {counted(len(files), 'file')} to {target}", as_json=as_json)


@benchmark.command()
def check(folder: Folder, as_json: AsJson = False) -> None:
    """Check whether the results of your method can stand beside the published ones.

    The lines must have every variant, seed and budget of each split that they name, be of the published data,
    protocol and versions, and state the method's settings. The command prints what is missing or wrong, one
    line each. The exit status is then 1.

    Example: `imujoco benchmark check docs/results/others/nearest-neighbour`
    """
    from imujoco_minari.benchmark.submissions import check_submission

    faults = check_submission(folder)
    lines = faults or [f"{folder}: whole, and of the published data, protocol and versions"]
    report({"whole": not faults, "faults": faults}, *lines, as_json=as_json)
    if faults:
        raise typer.Exit(FAILED)


def _say_cost(
    grid: FewShotGrid | OfflineGrid, recipes: Sequence[Recipe], jobs: int, *, dry_run: bool, as_json: bool
) -> None:
    """Say what a grid will compute, and which datasets are to be published first. Exit if it is a dry run."""
    cells, seconds = grid.cells(), grid.seconds() / jobs
    missing = [each for each in map(plan, recipes) if each.action != "leave alone"]
    say(f"{counted(cells, 'cell')}: about {time_text(seconds)} with --jobs {jobs}")
    if missing:
        say(f"to publish first: {publishing_line(missing, jobs)}")
    if dry_run:
        if as_json:
            print_json({"cells": cells, "seconds": seconds, "publish": [each.dataset_id for each in missing]})
        raise typer.Exit


def _say_changed(lines: Sequence[Line]) -> None:
    from imujoco_minari.benchmark.checks import changes

    for line in changes(lines):
        say(line)


def _recipes(dataset_ids: Sequence[str]) -> list[Recipe]:
    """Return the recipes of the datasets that this package can make.

    Raises:
        DatasetNotFoundError: if a dataset of another tier is not in the root, since its policy is not known.
    """
    from imujoco_minari.policies.tiers import TIERS
    from imujoco_minari.publishing.recipes import Recipe
    from imujoco_minari.storage import minari_root

    recipes = []
    for dataset_id in dataset_ids:
        variant, tier = parse_dataset_id(dataset_id)
        if tier in TIERS:
            recipes.append(Recipe(variant, tier))
        elif not minari_root.exists(dataset_id):
            raise DatasetNotFoundError(
                f"{dataset_id} is not in the Minari root; make it with "
                f"`imujoco publish {variant} --tier {tier} --policy FILE`"
            )
    return recipes


def _publish(recipes: Sequence[Recipe], jobs: int, *, trains: bool = True) -> None:
    """Publish the datasets that the Minari root lacks. Before that, check that networks can be trained."""
    from imujoco_minari.benchmark.networks import import_optax
    from imujoco_minari.publishing.publisher import publish_all

    if trains:
        import_optax()
    outcomes = publish_all(recipes, jobs=jobs)
    for outcome in advancing(outcomes, "preparing datasets", len(recipes)):
        if outcome.error:
            raise BenchmarkError(outcome.error)


def _show(scores: Sequence[MethodScore], as_json: bool = False) -> None:
    if as_json:
        print_json(list(map(vars, scores)))
        return
    key = attrgetter("group", "tier", "category")
    for (group, tier, category), own in groupby(sorted(scores, key=key), key):
        out.print(f"{group}, {tier}, {category} variants")
        print_table(_COLUMNS, [_row(score) for score in own], numeric=_COLUMNS[1:2] + _COLUMNS[3:])
        out.print("")


def _show_comparison(rows: Sequence[Comparison]) -> None:
    shown = [
        ["" if v is None else f"{v:.3f}" if isinstance(v, float) else str(v) for v in row] for row in rows
    ]
    out.print("Errors of the actions in the published comparison")
    print_table(_ERROR_COLUMNS, shown, numeric=_ERROR_COLUMNS[1:])


def _row(score: MethodScore) -> list[str]:
    numbers = (score.iqm, score.low, score.high, score.error)
    shown = ["-" if math.isnan(number) else f"{number:.3f}" for number in numbers]
    return [score.method, str(score.steps), score.budget, *shown, str(score.variants), str(score.runs)]
