"""``imujoco publish``, ``combine`` and ``verify``: datasets into, within and out of the Minari root."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from imujoco_minari.cli.app import (
    AsJson,
    Category,
    Robot,
    app,
    fail,
    out,
    print_json,
    print_table,
    progress,
    say,
)
from imujoco_minari.errors import DatasetNotFoundError, VariantError
from imujoco_minari.variants import EXPERT, Variant, bases, catalogue

if TYPE_CHECKING:
    from imujoco_minari.publishing.publisher import Published
    from imujoco_minari.publishing.recipes import Recipe

Jobs = Annotated[int, typer.Option("--jobs", "-j", min=1, help="How many processes.")]
Backend = Annotated[
    str | None,
    typer.Option("--backend", help="Where the jobs run: loky (this machine) or ray (a running Ray cluster)."),
]
Tier = Annotated[str, typer.Option("--tier", "-t", help="Which policy makes the data.")]


@app.command("publish")
def publish_datasets(
    variants: Annotated[list[str] | None, typer.Argument(help="Variant ids.")] = None,
    robot: Robot = None,
    category: Category = None,
    everything: Annotated[bool, typer.Option("--all", help="All 154 variants.")] = False,
    tier: Tier = EXPERT,
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Episodes a dataset.")] = 100,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Base seed of all that is random.")] = 0,
    policy: Annotated[
        Path | None, typer.Option("--policy", help="A Stable-Baselines3 .zip or .safetensors.")
    ] = None,
    stochastic: Annotated[bool, typer.Option("--stochastic", help="Sample actions, not their mode.")] = False,
    jobs: Jobs = 1,
    backend: Backend = None,
    force: Annotated[bool, typer.Option("--force", help="Replace what has the id.")] = False,
    as_json: AsJson = False,
) -> None:
    """Publish variants as Minari datasets.

    A dataset that is there already is left alone. A variant that fails is named at the end.

    Examples: `imujoco publish hopper-massdec_25_leggeom`,
    `imujoco publish --robot hopper --jobs 2`,
    `imujoco publish walker2d-base --tier mine --policy sac.zip`
    """
    from imujoco_minari.publishing.recipes import Recipe

    chosen = select(variants or [], robot, category, everything)
    recipes = [Recipe(variant, tier, episodes, seed, policy, stochastic) for variant in chosen]
    finish(_publish(recipes, jobs, backend, force, quiet=as_json), as_json)


def finish(outcomes: list[Published], as_json: bool) -> None:
    """Print what is left to say of a batch, its failures last, and exit with 1 when there are any."""
    if as_json:
        print_json([vars(outcome) for outcome in outcomes])
    failures = [outcome for outcome in outcomes if outcome.error]
    for outcome in failures:
        fail(f"{outcome.dataset_id}: {outcome.error}" if len(outcomes) > 1 else outcome.error)
    if len(outcomes) > 1:
        made = sum(outcome.created for outcome in outcomes)
        say(f"{made} published, {len(outcomes) - made - len(failures)} there already, {len(failures)} failed")
    if failures:
        raise typer.Exit(1)


def select(names: list[str], robot: str | None, category: str | None, everything: bool) -> list[Variant]:
    """Return the variants that arguments and filters name; the filters go over the catalogue and the bases.

    Raises:
        VariantError: when nothing is named.
    """
    if names:
        return list(dict.fromkeys(Variant.parse(name) for name in names))
    if not (robot or category or everything):
        raise VariantError("name a variant, or choose some by --robot, --category or --all")
    chosen = list(catalogue(robot, category))
    return chosen if category else [base for base in bases() if robot in (None, base.robot)] + chosen


def _publish(
    recipes: list[Recipe], jobs: int, backend: str | None, force: bool, *, quiet: bool
) -> list[Published]:
    from imujoco_minari.errors import ImujocoError
    from imujoco_minari.publishing.publisher import Published, publish, publish_all

    outcomes = []
    if len(recipes) == 1 and backend is None:
        with progress(str(recipes[0].variant), recipes[0].episodes, quiet=quiet) as advance:
            try:
                outcomes = [publish(recipes[0], jobs=jobs, force=force, on_episode=advance)]
            except ImujocoError as error:
                outcomes = [Published(recipes[0].dataset_id, error=str(error))]
        report(outcomes[0], quiet)
        return outcomes
    with progress("publishing", len(recipes), quiet=quiet) as advance:
        for outcome in publish_all(recipes, jobs=jobs, force=force, backend=backend):
            outcomes.append(outcome)
            report(outcome, quiet)
            advance()
    return outcomes


def report(outcome: Published, quiet: bool) -> None:
    """Print what became of one dataset, unless it failed or ``quiet`` is set."""
    if quiet or outcome.error:
        return
    if outcome.created:
        out.print(
            f"published {outcome.dataset_id}: {outcome.episodes} episodes, {outcome.steps} steps, return "
            f"{outcome.return_mean:.1f} ± {outcome.return_std:.1f}, in {outcome.seconds:.1f} s\n"
            f"  at {outcome.path}"
        )
    else:
        out.print(
            f"left alone {outcome.dataset_id}: it is there already, at {outcome.path} (--force replaces it)"
        )


@app.command()
def combine(
    ids: Annotated[list[str] | None, typer.Argument(help="Dataset ids.")] = None,
    new_id: Annotated[str | None, typer.Option("--id", help="Id of the collection.")] = None,
    robot: Robot = None,
    category: Category = None,
    tier: Tier = EXPERT,
    link: Annotated[
        bool, typer.Option("--link", help="Refer to the episodes instead of copying them.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace what has the id.")] = False,
    as_json: AsJson = False,
) -> None:
    """Combine datasets of one robot into a collection.

    With --robot, all datasets of the catalogue that are published here.

    Examples: `imujoco combine --robot hopper`, `imujoco combine ID ID --id imujoco/hopper-mine-v0`
    """
    from imujoco_minari.publishing.combiner import collection_id, combine_datasets, published_ids

    if ids and (robot or category):
        raise VariantError("give dataset ids or --robot, not both")
    if ids:
        if new_id is None:
            raise VariantError("name the collection with --id, as in imujoco/hopper-mine-v0")
        sources = ids
    else:
        if robot is None:
            raise VariantError("give dataset ids and --id, or --robot")
        sources = published_ids(robot, category, tier)
        new_id = new_id or collection_id(robot, category, tier)
        if not sources:
            raise DatasetNotFoundError(
                f"no {tier} dataset of {robot} is published here: "
                f"`imujoco publish --robot {robot}` makes them"
            )
    dataset = combine_datasets(sources, new_id, link=link, force=force)
    summary = {
        "dataset_id": new_id,
        "path": str(dataset.storage.data_path.parent),
        "combined_datasets": sources,
        "episodes": dataset.total_episodes,
        "steps": dataset.total_steps,
        "linked": link,
    }
    if as_json:
        print_json(summary)
        return
    out.print(
        f"combined {len(sources)} datasets into {new_id}: {summary['episodes']} episodes, "
        f"{summary['steps']} steps{', linked' if link else ''}\n  at {summary['path']}"
    )


@app.command("verify")
def verify_datasets(
    ids: Annotated[list[str], typer.Argument(help="Dataset ids.")],
    replay: Annotated[bool, typer.Option(help="Replay every episode from its seed and actions.")] = True,
    jobs: Jobs = 1,
    backend: Backend = None,
    as_json: AsJson = False,
) -> None:
    """Check datasets: structure, attributes, digests, and the replay of every episode, bit for bit.

    Exits with 1 when anything is wrong.

    Example: `imujoco verify imujoco/hopper-massdec_25_leggeom-v0`
    """
    from imujoco_minari.verification import verify

    results = {}
    for dataset_id in ids:
        with progress(dataset_id, _episodes(dataset_id), quiet=as_json or not replay) as advance:
            results[dataset_id] = verify(
                dataset_id, replay=replay, jobs=jobs, backend=backend, on_episode=advance
            )
    if as_json:
        print_json(
            {dataset_id: [vars(finding) for finding in findings] for dataset_id, findings in results.items()}
        )
    else:
        for dataset_id, findings in results.items():
            # An imported dataset has no seeds, and what cannot be replayed is sound in less.
            imported = _stated(dataset_id).get("replayable") is False
            sound = "sound, but for a replay: it was imported without seeds" if imported else "sound"
            out.print(f"{dataset_id}: " + (f"{len(findings)} findings" if findings else sound))
            if findings:
                print_table(("where", "what"), [[finding.where, finding.what] for finding in findings])
    if any(results.values()):
        raise typer.Exit(1)


def _episodes(dataset_id: str) -> int:
    """Return how many episodes a dataset states that it has, for the progress bar alone."""
    episodes = _stated(dataset_id).get("total_episodes")
    return episodes if isinstance(episodes, int) else 0


def _stated(dataset_id: str) -> dict[str, Any]:
    """Return what a dataset's metadata state; empty where they cannot be read."""
    from imujoco_minari.storage import minari_root
    from imujoco_minari.verification.identity import read_metadata

    return read_metadata(minari_root.dataset_folder(dataset_id) / "data")
