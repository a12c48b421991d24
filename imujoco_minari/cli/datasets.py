"""``imujoco publish``, ``combine``, ``verify`` and ``delete``: the datasets of the Minari root."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import filesize

from imujoco_minari.cli import options
from imujoco_minari.cli.app import advancing, app, exit_code, gather
from imujoco_minari.cli.estimates import cost, plan, publishing_line
from imujoco_minari.cli.options import option, spread
from imujoco_minari.cli.printing import (
    counted,
    fail,
    out,
    print_json,
    print_table,
    printable,
    progress,
    report,
    say,
)
from imujoco_minari.cli.selection import DatasetChoice, VariantChoice
from imujoco_minari.errors import ImujocoError, VariantError
from imujoco_minari.policies.tiers import MEDIUM_REPLAY
from imujoco_minari.storage import minari_root
from imujoco_minari.variants import EXPERT
from imujoco_minari.variants.named_collections import NamedCollection

if TYPE_CHECKING:
    from imujoco_minari.cli.estimates import Planned
    from imujoco_minari.publishing.outcome import Deleted, Published
    from imujoco_minari.publishing.recipes import Recipe
    from imujoco_minari.verification import Findings


@app.command("publish")
@spread
def publish_datasets(
    choice: VariantChoice,
    tiers: options.Tiers = None,
    episodes: options.EpisodeCount = 100,
    seed: options.Seed = 0,
    policy: options.PolicyFile = None,
    stochastic: Annotated[bool, option("--stochastic", "Sample actions, do not take their mode.")] = False,
    jobs: options.Jobs = 1,
    backend: options.Backend = None,
    force: options.Force = False,
    dry_run: options.DryRun = False,
    as_json: options.AsJson = False,
) -> None:
    """Publish variants as Minari datasets.

    The policy of each tier makes the episodes; the default is the expert. A dataset that exists already is
    left alone. The command goes on after a failure and names the failures at the end. The tier medium-replay
    records a training run, which takes minutes: see --dry-run.

    Examples: `imujoco publish hopper-massdec_25_leggeom`,
    `imujoco publish --robot hopper --tier expert --tier random --jobs 2`,
    `imujoco publish --all --with-base --dry-run`,
    `imujoco publish walker2d-base --tier mine --policy sac.zip`
    """
    from imujoco_minari.publishing.recipes import Recipe
    from imujoco_minari.publishing.sizes import check_space

    if policy is not None and not tiers:
        raise typer.BadParameter("--policy needs a --tier, which names the dataset: for example --tier mine")
    chosen = choice.variants()
    recipes = [
        Recipe(variant, tier, episodes, seed, policy, stochastic)
        for tier in dict.fromkeys(tiers or [EXPERT])
        for variant in chosen
    ]
    if dry_run or len(recipes) > 1 or recipes[0].tier == MEDIUM_REPLAY:
        planned = [plan(recipe, force=force) for recipe in recipes]
        say(publishing_line(planned, jobs))
        if dry_run:
            gather(planned, _describe_planned, as_json=as_json)
            return
        check_space(counted(len(recipes), "dataset"), sum(each.bytes for each in planned))
    gather(_published(recipes, jobs, backend, force), describe_published, as_json=as_json)


def _published(recipes: list[Recipe], jobs: int, backend: str | None, force: bool) -> Iterator[Published]:
    """Publish each recipe and yield its outcome, behind a bar of datasets; for one dataset, of episodes."""
    from imujoco_minari.publishing.outcome import Published
    from imujoco_minari.publishing.publisher import publish_all, publish_recipe

    if len(recipes) > 1 or backend is not None:
        outcomes = publish_all(recipes, jobs=jobs, force=force, backend=backend)
        yield from advancing(outcomes, "publishing", len(recipes))
        return
    total = None if recipes[0].tier == MEDIUM_REPLAY else recipes[0].episodes
    with progress(str(recipes[0].variant), total) as advance:
        try:
            outcome = publish_recipe(recipes[0], jobs=jobs, force=force, on_episode=advance)
        except ImujocoError as error:
            outcome = Published.failed(recipes[0].dataset_id, error)
    yield outcome


def describe_published(outcome: Published) -> tuple[str, ...]:
    """Return what to print of a dataset that was published or existed already."""
    if not outcome.created:
        exists = f"it exists already, at {outcome.path} (--force replaces it)"
        return "left alone", f"{outcome.dataset_id}: {exists}"
    return (
        "published",
        f"{outcome.dataset_id}: {counted(outcome.episodes, 'episode')}, {counted(outcome.steps, 'step')}, "
        f"return {outcome.return_mean:.1f} ± {outcome.return_std:.1f}, in {outcome.seconds:.1f} s",
        f"  at {outcome.path}",
    )


def _describe_planned(planned: Planned) -> tuple[str, ...]:
    if planned.action == "leave alone":
        return "would leave alone", f"{planned.dataset_id}: it exists already"
    episodes = counted(planned.episodes, "episode") if planned.episodes else "a training run"
    words = f"{episodes}, {cost(planned.bytes, planned.seconds)}"
    return f"would {planned.action}", f"{planned.dataset_id}: {words}"


@app.command()
def combine(
    ids: options.MaybeDatasetIds = None,
    new_id: Annotated[str | None, option("--id ID", "Id of the collection.")] = None,
    robot: options.Robot = None,
    category: options.Category = None,
    with_base: options.WithBase = False,
    tier: options.Tier = EXPERT,
    partial: Annotated[bool, option("--partial", "Leave out what is not published. Needs --id.")] = False,
    link: Annotated[bool, option("--link", "Refer to the episodes instead of copying them.")] = False,
    force: options.Force = False,
    as_json: options.AsJson = False,
) -> None:
    """Combine datasets of one robot into a collection.

    With --robot, it combines the datasets of all variants of the robot, and stops if one is not published.
    The default id, as imujoco/hopper-all-v0, stands for these variants. Name other sets with --id.
    If the sources of a collection have not changed, it is left alone.

    Examples: `imujoco combine --robot hopper`,
    `imujoco combine --robot hopper --category mass --tier random`,
    `imujoco combine --robot hopper --partial --id imujoco/hopper-some-v0`,
    `imujoco combine imujoco/hopper-base-v0 imujoco/hopper-massdec_25_leggeom-v0 --id imujoco/hopper-mine-v0`
    """
    from imujoco_minari.publishing.combiner import combine_datasets

    if ids and partial:
        raise VariantError("--partial leaves out variants that --robot chooses: give no ids with it")
    tiers = [tier] if tier != EXPERT else None
    choice = DatasetChoice(robot, category, with_base=with_base, ids=ids, tiers=tiers)
    sources = choice.datasets(published=partial)
    if new_id is None:
        if ids or robot is None or with_base or partial:
            raise VariantError("name the collection with --id, as in imujoco/hopper-mine-v0")
        new_id = NamedCollection(robot, category, tier).dataset_id
    if choice and (missing := [source for source in sources if not minari_root.exists(source)]):
        for dataset_id in missing:
            say(f"  {dataset_id}")
        other = ", or combine the others with --partial and an --id"
        raise choice.not_published(len(missing), len(sources), other)
    created = force or not minari_root.exists(new_id)
    dataset = combine_datasets(sources, new_id, link=link, force=force)
    path, episodes, steps = dataset.storage.data_path.parent, dataset.total_episodes, dataset.total_steps
    line = f"left alone {new_id}: it combines these {len(sources)} datasets already"
    if created:
        line = f"combined {counted(len(sources), 'dataset')} into {new_id}: "
        line += f"{counted(int(episodes), 'episode')}, {counted(int(steps), 'step')}"
        line += ", linked" if link else ""
    document = {
        "dataset_id": new_id,
        "path": path,
        "created": created,
        "combined_datasets": sources,
        "linked": link,
        "episodes": episodes,
        "steps": steps,
    }
    report(document, line, f"  at {path}", as_json=as_json)


@app.command("verify")
@spread
def verify_datasets(
    choice: DatasetChoice,
    replay: Annotated[bool, typer.Option(help="Replay every episode from its seed and actions.")] = True,
    published: Annotated[bool, option("--published", "Compare with the digest of this version.")] = False,
    jobs: options.Jobs = 1,
    backend: options.Backend = None,
    as_json: options.AsJson = False,
) -> None:
    """Check datasets for damage, and replay every episode.

    It checks structure, attributes and digests. It checks that the dataset is what this package makes for
    its id, and that every replayed value is equal, bit for bit. It states what it cannot check. With
    filters, it checks the datasets of the chosen variants that are in the Minari root. It exits with 1
    when a dataset has a finding.

    With --published, a dataset must also have the digest that this version of the package lists for it. So it
    is the dataset that this version makes. A dataset without a listed digest is not checked, and the exit
    code is 2.

    Examples: `imujoco verify imujoco/hopper-massdec_25_leggeom-v0`,
    `imujoco verify --robot hopper --tier random --jobs 2`,
    `imujoco verify imujoco/hopper-base-v0 --published`
    """
    from imujoco_minari.verification import verify

    chosen = choice.datasets()
    check = partial(verify, replay=replay, published=published, jobs=jobs, backend=backend)
    results: dict[str, Findings] = {}
    errors: list[ImujocoError] = []
    for dataset_id in chosen:
        try:
            bar = progress(dataset_id, _episodes(dataset_id)) if replay else nullcontext(lambda: None)
            with bar as advance:
                results[dataset_id] = check(dataset_id, on_episode=advance)
        except ImujocoError as error:
            errors.append(error)
            continue
        if not as_json:
            _print_findings(dataset_id, results[dataset_id], "sound, as published" if published else "sound")
    if as_json:
        document: dict[str, Any] = {
            dataset_id: [vars(finding) for finding in findings] for dataset_id, findings in results.items()
        }
        exceptions = {name: found.exceptions for name, found in results.items() if found.exceptions}
        document |= {"exceptions": exceptions} if exceptions else {}
        print_json(document | ({"error": "; ".join(map(str, errors))} if errors else {}))
    for message in map(str, errors):
        fail(message)
    if len(chosen) > 1:
        sound = sum(not findings for findings in results.values())
        say(f"{sound} sound, {len(results) - sound} with findings, {len(errors)} not checked")
    if any(results.values()):
        raise typer.Exit(1)
    if errors:
        raise typer.Exit(exit_code([each.missing for each in errors]))


def _print_findings(dataset_id: str, findings: Findings, sound: str) -> None:
    if findings:
        out.print(f"{dataset_id}: {counted(len(findings), 'finding')}")
        print_table(("where", "what"), [[finding.where, finding.what] for finding in findings])
        return
    exceptions = f", but {'; '.join(findings.exceptions)}" if findings.exceptions else ""
    out.print(f"{dataset_id}: {sound}{exceptions}")


def _episodes(dataset_id: str) -> int:
    """Return the number of episodes that a dataset states, for the progress bar."""
    from imujoco_minari.storage.metadata import read_metadata

    episodes = read_metadata(minari_root.dataset_folder(dataset_id) / "data").get("total_episodes")
    return episodes if isinstance(episodes, int) else 0


@app.command("delete")
@spread
def delete_datasets(
    choice: DatasetChoice,
    yes: Annotated[bool, option("--yes -y", "Do not ask.")] = False,
    force: Annotated[bool, option("--force", "Delete datasets that a linked collection refers to.")] = False,
    as_json: options.AsJson = False,
) -> None:
    """Delete datasets from the Minari root.

    It lists the datasets and asks first. If a linked collection refers to a dataset, the dataset is kept,
    unless the collection is deleted too. A folder with other files beside a dataset is kept.

    Examples: `imujoco delete imujoco/hopper-massdec_25_leggeom-v0`,
    `imujoco delete --robot hopper --tier random`,
    `imujoco delete --all --with-base --yes`
    """
    from imujoco_minari.publishing.removal import delete

    chosen = choice.datasets()
    here = [dataset_id for dataset_id in chosen if minari_root.exists(dataset_id)]
    if here and not yes:
        _ask(here)
    gather(delete(chosen, force=force), _describe_deleted, as_json=as_json)


def _ask(ids: list[str]) -> None:
    """Ask whether to delete datasets. Stop if the answer is no, or if nobody can answer."""
    if not sys.stdin.isatty():
        raise VariantError(f"deleting {counted(len(ids), 'dataset')} needs an answer: give --yes in a script")
    for dataset_id in ids:
        say(f"  {dataset_id}")
    root = printable(minari_root.datasets_root())
    typer.confirm(f"Delete {counted(len(ids), 'dataset')} from {root}?", abort=True, err=True)


def _describe_deleted(outcome: Deleted) -> tuple[str, ...]:
    return "deleted", f"{outcome.dataset_id}: {filesize.decimal(outcome.bytes)}"
