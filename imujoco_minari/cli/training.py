"""``imujoco train``, ``imujoco policies`` and ``imujoco policy``: train, list and export experts."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from imujoco_minari.cli import options
from imujoco_minari.cli.app import advancing, app, gather
from imujoco_minari.cli.datasets import describe_published
from imujoco_minari.cli.estimates import training_line
from imujoco_minari.cli.options import Output, argument, option, spread
from imujoco_minari.cli.printing import counted, out, print_json, print_table, say
from imujoco_minari.cli.selection import Filters, VariantChoice
from imujoco_minari.errors import CatalogueError
from imujoco_minari.policies import expert_variants, policies_folder
from imujoco_minari.policies.experts import readable_record, start_of
from imujoco_minari.policies.rungs import mean_return, share_of
from imujoco_minari.policies.standing import COLUMNS, share_of_base, standings
from imujoco_minari.variants import BASE, CATEGORIES, ROBOTS, Variant, bases, catalogue

if TYPE_CHECKING:
    from imujoco_minari.publishing.outcome import Published
    from imujoco_minari.training.run import Progress
    from imujoco_minari.training.sweep import Trained
    from imujoco_minari.training.task import Plan, Task

policy = typer.Typer(help="Use a policy in other libraries.")
app.add_typer(policy, name="policy")


@app.command("train")
@spread
def train_variants(
    choice: VariantChoice,
    universal: Annotated[bool, option("--universal", "Train the universal policy of --robot.")] = False,
    scratch: Annotated[bool, option("--scratch", "Do not start from another agent.")] = False,
    max_steps: Annotated[
        int | None, option("--max-steps N", "Stop at the first evaluation after N steps.", min=0)
    ] = None,
    target: Annotated[
        float | None, option("--target X", "Score to stop at: the mean of mean and lowest return.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        option("--set NAME=VALUE", "A hyperparameter, as in batch_size=256; may be repeated."),
    ] = None,
    seed: options.Seed = 0,
    jobs: options.Jobs = 1,
    backend: options.Backend = None,
    nice: Annotated[int, option("--nice N", "Lower the priority by this much.", min=0, max=19)] = 0,
    device: Annotated[str | None, option("--device NAME", "cpu or gpu. [default: the faster one]")] = None,
    state: Annotated[Path | None, option("--state FOLDER", "Folder of unfinished runs.")] = None,
    output: Output = None,
    improve: Annotated[bool, option("--improve", "Train finished policies on; keep the better.")] = False,
    record_replay: Annotated[bool, option("--record-replay", "Publish the run as the tier replay.")] = False,
    as_json: options.AsJson = False,
) -> None:
    """Train an expert for each variant.

    A variant starts from the robot's universal policy or from its base robot's agent, whichever is better.
    The choice takes some minutes. A base robot starts from scratch. The variants need not be in the
    catalogue. A killed run continues where it stopped, and a finished one is trained again only with
    --improve. The command goes on after a failure and names the failures at the end. Policies are written
    to your own policies folder, or to the folder --output.

    With --universal, one policy of the robot is trained that is told its variant. It acts in every variant
    that has no expert of its own. It is trained in many variants first, which takes an hour. Then the best
    known policies are distilled into it. --max-steps 0 only distils, which takes about half an hour.

    Examples: `imujoco train hopper-massinc_37_torsogeom`,
    `imujoco train --universal --robot hopper --improve --max-steps 0`,
    `imujoco train --robot hopper --jobs 2 --nice 10`,
    `imujoco train hopper-base --record-replay`
    """
    from imujoco_minari.training.hyperparameters import hyperparameter_changes
    from imujoco_minari.training.task import Plan, default_state

    if universal and (choice.robot is None or choice.names or choice.category):
        raise typer.BadParameter("--universal trains one policy a robot: give --robot ROBOT and no variants")
    for_variants = {
        "--scratch": scratch,
        "--target": target is not None,
        "--jobs": jobs > 1,
        "--backend": backend is not None,
        "--record-replay": record_replay,
    }
    given = [name for name, is_given in for_variants.items() if is_given]
    if universal and given:
        raise typer.BadParameter(f"--universal has no {given[0]}")
    if max_steps == 0 and not universal:
        raise typer.BadParameter("--max-steps 0 only distils a universal policy: add --universal")
    chosen = choice.variants()
    try:
        changes = hyperparameter_changes(settings or [])
    except CatalogueError as error:
        raise typer.BadParameter(str(error)) from None
    if max_steps is not None:
        changes["max_steps"] = max_steps
    plan = Plan(
        state=state or default_state(),
        policies=output or policies_folder(),
        scratch=scratch,
        seed=seed,
        target=target,
        changes=changes,
        nice=nice,
        improve=improve,
        device=device,
    )
    if universal and choice.robot is not None:
        gather(_universal(choice.robot, plan), describe_universal, as_json=as_json, name="variant")
        return
    if len(chosen) > 1:
        say(training_line(chosen, output, jobs, improve=improve or record_replay))
    if record_replay:
        os.nice(nice)
        gather(_recorded(chosen, plan), describe_published, as_json=as_json)
        return
    outcomes = _trained(chosen, plan, jobs, backend)
    gather(outcomes, partial(describe_trained, plan=plan), as_json=as_json, name="variant")


def _recorded(chosen: list[Variant], plan: Plan) -> Iterator[Published]:
    """Publish the transitions of a training run of each variant."""
    from imujoco_minari.publishing.training_data import record_training
    from imujoco_minari.training.sweep import task

    for variant in chosen:
        # All of the run is recorded, not only the way to a target.
        whole = replace(task(variant, plan, say), target=float("inf"))
        folder = plan.state / f"{variant}-replay"
        yield record_training(whole, folder, device=plan.device, on_interval=_tell)


def _trained(chosen: list[Variant], plan: Plan, jobs: int, backend: str | None) -> Iterator[Trained]:
    """Train each variant and yield the outcome."""
    from imujoco_minari.training.sweep import train, train_all

    if len(chosen) == 1 and backend is None:
        os.nice(plan.nice)
        yield train(chosen[0], plan, _tell, say)
        return
    outcomes = train_all(chosen, plan, jobs=jobs, backend=backend)
    yield from advancing(outcomes, "training", len(chosen))


def _universal(robot: str, plan: Plan) -> Iterator[Trained]:
    """Train the universal policy of a robot and yield the outcome."""
    from imujoco_minari.training.universal import train_universal

    os.nice(plan.nice)
    yield train_universal(robot, plan, say=say, on_interval=_tell)


def _tell(state: Progress, task: Task) -> None:
    """Print a line after each evaluation, with the longest time that is left."""
    last = state.evaluations[-1] if state.evaluations else {}
    if last.get("steps") != state.steps:
        return
    left = ""
    if state.steps:
        steps_left = max(0, task.settings.max_steps - state.steps)
        left = f", at most {steps_left * state.wall_seconds / state.steps / 60:.0f} left"
    say(
        f"{state.steps:>9,} steps  {_found(last)}  best score {state.best_score:8.6g}"
        f"  {state.wall_seconds / 60:6.1f} min{left}"
    )


def _found(entry: dict[str, Any]) -> str:
    """Return the evaluations of a run's present and averaged weights."""
    present, average = entry["present"], entry.get("average", entry["present"])
    if "median" in present:
        return (
            f"{present['median']:.3f} of the base (median), lowest {present['min']:.3f}; "
            f"averaged {average['median']:.3f}, {average['min']:.3f}"
        )
    return (
        f"return {present['return_mean']:8.1f} ± {present['return_std']:6.1f}"
        f"  averaged {average['return_mean']:8.1f}"
    )


# An expert with less than this share of its base's return may have trained badly by chance.
_WEAK = 0.5


def describe_trained(outcome: Trained, plan: Plan) -> tuple[str, ...]:
    """Return what to print of a variant that was trained or left alone."""
    variant = outcome.variant
    if outcome.created:
        lines = ["trained", f"{variant}: {_made(outcome.record)}"]
    elif outcome.tried:
        lines = [
            "kept",
            f"{variant}: {_made(outcome.record)}; not better: {_made(outcome.tried)}",
            "  what counts is the mean of mean and lowest return, on the same episodes: "
            f"{outcome.tried['kept_score']:.1f} and {outcome.tried['score']:.1f}",
        ]
    else:
        lines = ["left alone", f"{variant}: it has an expert already"]
    evaluated = "evaluation" in outcome.record
    share = share_of_base(outcome.record, plan.policies) if evaluated else None
    if share is not None and share < _WEAK:
        again = "--improve --seed 1" if outcome.record["start"] == "scratch" else "--scratch --improve"
        better = f"`imujoco train {variant} {again}` may do better"
        lines.append(f"  its return is {share:.2f} of the base expert's: {better}")
    return tuple(lines)


def describe_universal(outcome: Trained) -> tuple[str, ...]:
    """Return what to print of a universal policy that was trained or left alone."""
    if not outcome.created:
        if outcome.tried:
            return "kept", f"{outcome.variant}: the new one is not better; try another --seed"
        return "left alone", f"{outcome.variant}: it exists already; --improve trains another round"
    measured = outcome.record["measured"]
    base = measured[f"{outcome.record['robot']}-{BASE}"]
    shares = sorted(share_of(mean_return(each), base) for each in measured.values())
    return "trained", (
        f"{outcome.variant}: of its return on the base, {shares[len(shares) // 2]:.2f} in the median variant "
        f"and {shares[0]:.2f} in the weakest"
    )


def _made(record: dict[str, Any]) -> str:
    """Return the return of a record's policy, and the training that made it."""
    if "evaluation" not in record:
        # Only the listed variants have an evaluation of the folded policy.
        return "the policy folded from the universal policy"
    evaluation = record["evaluation"]
    told = f"return {evaluation['return_mean']:.1f} ± {evaluation['return_std']:.1f}"
    if "steps" not in record:
        return f"{told}, the {record['start']}"
    return (
        f"{told} over {evaluation['episodes']} episodes, after {record['steps']:,} steps from "
        f"{start_of(record)}, {record['wall_seconds'] / 60:.1f} min"
    )


@app.command()
def policies(
    robot: options.Robot = None,
    category: options.Category = None,
    with_base: options.WithBase = False,
    summary: Annotated[bool, option("--summary", "Print a line for each robot and category.")] = False,
    as_json: options.AsJson = False,
) -> None:
    """List the experts and their returns.

    It lists your own policies and the shipped ones. A variant without a policy of its own acts as the
    universal policy of its robot. Without filters, it lists every expert, also those of the base robots and
    of variants that have a policy but are not in the catalogue.

    Examples: `imujoco policies`, `imujoco policies --robot hopper --with-base`, `imujoco policies --summary`
    """
    filters = Filters(robot, category, with_base=with_base)
    chosen = filters.variants()
    if summary:
        base = [BASE] if with_base or not filters else []
        robots = ROBOTS if robot is None else (robot,)
        lines = standings(robots, base + [each for each in CATEGORIES if category in (None, each)])
        if as_json:
            print_json([line._asdict() for line in lines])
            return
        print_table(COLUMNS, [line.cells() for line in lines], numeric=COLUMNS[2:])
        out.print(
            "",
            "median and min: return as a share of the base expert's",
            "medium and ranked: number of policies whose rungs have the returns that these tiers need",
        )
        return
    if not filters and not with_base:
        chosen = list(dict.fromkeys((*bases(), *catalogue(), *expert_variants())))
    found = {variant: dict(readable_record(variant)) for variant in chosen}
    found = {variant: record for variant, record in found.items() if "evaluation" in record}
    if as_json:
        print_json(list(found.values()))
        return
    columns = ("variant", "algorithm", "start", "steps", "return", "std", "min", "of base", "length")
    rows = [_row(variant, record) for variant, record in found.items()]
    print_table(columns, rows, numeric=columns[3:])
    out.print("", f"{counted(len(rows), 'policy')}; your own are in {policies_folder()}")


@policy.command()
def export(
    variant: options.VariantId,
    path: Annotated[Path, argument("FILE", "The .zip to write.")],
    force: options.Force = False,
) -> None:
    """Write a variant's expert for Stable-Baselines3.

    The file is a zip that `stable_baselines3.SAC.load` opens. Its critics are new: only the actor is trained.

    Example: `imujoco policy export hopper-massdec_25_leggeom expert.zip`
    """
    from imujoco_minari.policies.sb3 import export_zip

    written = export_zip(Variant.parse(variant), path, force=force)
    out.print(f"wrote {written}: `stable_baselines3.SAC.load({str(written)!r})` opens it")


def _row(variant: Variant, record: dict[str, Any]) -> list[str]:
    evaluation = record["evaluation"]
    share = share_of_base(record)
    numbers = [f"{evaluation[key]:.0f}" for key in ("return_mean", "return_std", "return_min")]
    return [
        str(variant),
        record["algorithm"],
        record["start"],
        f"{record['steps']:,}" if "steps" in record else "-",
        *numbers,
        "-" if share is None else f"{share:.2f}",
        f"{evaluation['length_mean']:.0f}",
    ]
