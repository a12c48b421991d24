"""``imujoco train`` and ``imujoco policies``: experts made, and listed."""

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
from imujoco_minari.cli.datasets import Backend, Jobs, report, select
from imujoco_minari.policies import expert_record, expert_variants, policies_folder
from imujoco_minari.policies.standing import COLUMNS, share_of_base, standings
from imujoco_minari.variants import BASE, CATEGORIES, ROBOTS, Variant

if TYPE_CHECKING:
    from imujoco_minari.training.hyperparameters import Hyperparameters
    from imujoco_minari.training.run import OnInterval, Progress
    from imujoco_minari.training.sweep import Plan, Trained

policy = typer.Typer(help="Take a policy elsewhere.", no_args_is_help=True)
app.add_typer(policy, name="policy")


@app.command("train")
def train_variants(
    variants: Annotated[
        list[str] | None, typer.Argument(help="Variant ids, of the catalogue or not.")
    ] = None,
    robot: Robot = None,
    category: Category = None,
    everything: Annotated[bool, typer.Option("--all", help="The three bases and all 154 variants.")] = False,
    scratch: Annotated[
        bool, typer.Option("--scratch", help="Do not start from the base robot's agent.")
    ] = False,
    max_steps: Annotated[
        int | None, typer.Option("--max-steps", min=1, help="Environment steps at most.")
    ] = None,
    target: Annotated[float | None, typer.Option("--target", help="Return to stop at.")] = None,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Seed of all that is random.")] = 0,
    jobs: Jobs = 1,
    backend: Backend = None,
    nice: Annotated[int, typer.Option("--nice", min=0, max=19, help="Lower the priority by this much.")] = 0,
    device: Annotated[
        str | None,
        typer.Option("--device", help="Where to compute updates: cpu or gpu; the best there is."),
    ] = None,
    state: Annotated[Path | None, typer.Option("--state", help="Folder of unfinished runs.")] = None,
    output: Annotated[Path | None, typer.Option("--output", help="Folder for finished policies.")] = None,
    improve: Annotated[
        bool, typer.Option("--improve", help="Train finished policies on, and keep what is better.")
    ] = False,
    record_replay: Annotated[
        bool, typer.Option("--record-replay", help="Publish the run's transitions as the tier replay.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Train an expert for each variant, from its base robot's agent; bases from scratch.

    A killed run goes on where it was, a finished one is never trained again, and a variant that fails
    is named at the end.

    Examples: `imujoco train hopper-massinc_37_torsogeom`, `imujoco train --robot hopper --jobs 2 --nice 10`
    """
    import os

    from imujoco_minari.training.sweep import Plan, default_state, train_all

    chosen = select(variants or [], robot, category, everything)
    changes: dict[str, Any] = {} if max_steps is None else {"max_steps": max_steps}
    plan = Plan(state or default_state(), output, scratch, seed, target, changes, nice, improve, device)
    if record_replay:
        os.nice(nice)
        _record(chosen, plan, as_json)
        return
    if len(chosen) == 1 and backend is None:
        os.nice(nice)
        outcomes = [_train_one(chosen[0], plan, as_json)]
    else:
        outcomes = []
        with progress("training", len(chosen), quiet=as_json) as advance:
            for outcome in train_all(chosen, plan, jobs=jobs, backend=backend):
                outcomes.append(outcome)
                _report(outcome, plan, as_json)
                advance()
    if as_json:
        print_json([vars(outcome) for outcome in outcomes])
    failures = [outcome for outcome in outcomes if outcome.error]
    for outcome in failures:
        fail(f"{outcome.variant}: {outcome.error}")
    if failures:
        raise typer.Exit(1)


def _record(chosen: list[Variant], plan: Plan, as_json: bool) -> None:
    from dataclasses import replace

    from imujoco_minari.publishing.training_data import record_training
    from imujoco_minari.training.sweep import task

    outcomes = []
    for variant in chosen:
        # All of the run is wanted, not the shortest way to a target.
        whole = replace(task(variant, plan), target=float("inf"))
        outcomes.append(
            record_training(whole, plan.state / f"{variant}-replay", on_interval=_teller(as_json))
        )
        if not as_json:
            report(outcomes[-1], quiet=False)
    if as_json:
        print_json([vars(outcome) for outcome in outcomes])


def _teller(quiet: bool) -> OnInterval:
    """Return what prints a line after each evaluation, with the time that is left at most."""

    def tell(state: Progress, hyperparameters: Hyperparameters) -> None:
        last = state.evaluations[-1] if state.evaluations else None
        if quiet or last is None or last["steps"] != state.steps:
            return
        steps_left = max(0, hyperparameters.max_steps - state.steps)
        left = steps_left * state.wall_seconds / state.steps
        say(
            f"{state.steps:>9,} steps  return {last['return_mean']:8.1f} ± {last['return_std']:6.1f}"
            f"  best {state.best_score:8.1f}  {state.wall_seconds / 60:6.1f} min, "
            f"at most {left / 60:.0f} left"
        )

    return tell


def _train_one(variant: Variant, plan: Plan, quiet: bool) -> Trained:
    from imujoco_minari.training.sweep import train

    outcome = train(variant, plan, _teller(quiet))
    _report(outcome, plan, quiet)
    return outcome


# An expert that has less than this share of its base's return may have met a dead end.
_WEAK = 0.5


def _report(outcome: Trained, plan: Plan, quiet: bool) -> None:
    if quiet or outcome.error:
        return
    if outcome.created:
        out.print(f"trained {outcome.variant}: {_made(outcome.record)}")
    elif outcome.tried:
        out.print(f"kept {outcome.variant}: {_made(outcome.record)}; not as good: {_made(outcome.tried)}")
    else:
        out.print(f"left alone {outcome.variant}: its expert is there already")
    # A generalist is nobody's expert.
    share = share_of_base(outcome.record, plan.policies) if isinstance(outcome.variant, Variant) else None
    if share is not None and share < _WEAK:
        again = "--improve --seed 1" if outcome.record["start"] == "scratch" else "--scratch --improve"
        out.print(
            f"  that is {share:.2f} of what the base's expert makes: "
            f"`imujoco train {outcome.variant} {again}` may find what this run did not"
        )


def _made(record: dict[str, Any]) -> str:
    """Return what a record's policy scores, and what made it."""
    evaluation = record["evaluation"]
    return (
        f"return {evaluation['return_mean']:.1f} ± {evaluation['return_std']:.1f} "
        f"over {evaluation['episodes']} episodes, after {record['steps']:,} steps from "
        f"{record['start']}, {record['wall_seconds'] / 60:.1f} min"
    )


@app.command()
def policies(
    robot: Robot = None,
    category: Category = None,
    summary: Annotated[
        bool, typer.Option("--summary", help="A line a robot and category instead of one a policy.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Tabulate the expert policies that are there, the user's and the shipped.

    Examples: `imujoco policies --robot hopper`, `imujoco policies --summary`
    """
    if summary and not as_json:
        _summarise([robot] if robot else list(ROBOTS), [category] if category else [BASE, *CATEGORIES])
        return
    chosen = [v for v in expert_variants() if robot in (None, v.robot) and category in (None, v.category)]
    records = [dict(expert_record(variant)) for variant in chosen]
    if as_json:
        print_json(records)
        return
    columns = ("variant", "algorithm", "start", "steps", "return", "std", "min", "of base", "length")
    rows = [_row(variant, record) for variant, record in zip(chosen, records, strict=True)]
    print_table(columns, rows, numeric=columns[3:])
    out.print(f"\n{len(rows)} policies; your own lie in {policies_folder()}")


@policy.command()
def export(
    variant: Annotated[str, typer.Argument(help="A variant id.")],
    path: Annotated[Path, typer.Argument(help="The .zip to write.")],
    force: Annotated[
        bool, typer.Option("--force", help="Replace an earlier export, and nothing else.")
    ] = False,
) -> None:
    """Write a variant's expert as a zip that stable_baselines3.SAC.load opens.

    Example: `imujoco policy export hopper-massdec_25_leggeom expert.zip`
    """
    from imujoco_minari.policies.sb3 import export_zip

    written = export_zip(Variant.parse(variant), path, force=force)
    out.print(f"wrote {written}: `stable_baselines3.SAC.load({str(written)!r})` opens it")


def _summarise(robots: list[str], categories: list[str]) -> None:
    """Print, for each robot and category, how the experts compare with their base's, and what they took."""
    rows = [standing.cells() for standing in standings(robots, categories)]
    print_table(COLUMNS, rows, numeric=COLUMNS[2:])
    out.print("\nmedian and min: return as a share of the base expert's")


def _row(variant: Variant, record: dict[str, Any]) -> list[str]:
    evaluation = record["evaluation"]
    share = share_of_base(record)
    numbers = [f"{evaluation[key]:.0f}" for key in ("return_mean", "return_std", "return_min")]
    return [
        str(variant),
        record["algorithm"],
        record["start"],
        f"{record['steps']:,}",
        *numbers,
        "-" if share is None else f"{share:.2f}",
        f"{evaluation['length_mean']:.0f}",
    ]
