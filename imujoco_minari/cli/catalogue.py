"""``imujoco list`` and ``imujoco show``: the variants, and what each changes in numbers."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from imujoco_minari.cli.app import AsJson, Category, Robot, app, out, print_json, print_table
from imujoco_minari.policies import expert_record, expert_variants
from imujoco_minari.storage import minari_root
from imujoco_minari.variants import Variant, bases, catalogue


@app.command("list")
def list_variants(robot: Robot = None, category: Category = None, as_json: AsJson = False) -> None:
    """List the variants of the catalogue, and what of each is here.

    Examples: `imujoco list`, `imujoco list --robot hopper --category length`
    """
    chosen = catalogue(robot, category)
    if category is None:
        chosen = tuple(base for base in bases() if robot in (None, base.robot)) + chosen
    experts = set(expert_variants())
    rows = [
        {
            "variant": str(variant),
            "robot": variant.robot,
            "category": variant.category,
            "body": variant.body,
            "percent": variant.percent,
            "policy": variant in experts,
            "published": minari_root.exists(variant.dataset_id()),
        }
        for variant in chosen
    ]
    if as_json:
        print_json(rows)
        return
    columns = ("variant", "category", "body", "percent", "policy", "published")
    print_table(columns, [[_cell(row[column]) for column in columns] for row in rows], numeric=("percent",))
    listed = sum(variant in set(catalogue()) for variant in chosen)
    out.print(
        f"\n{listed} variants and {len(chosen) - listed} bases; "
        f"{sum(bool(row['policy']) for row in rows)} with an expert policy, "
        f"{sum(bool(row['published']) for row in rows)} published in {minari_root.datasets_root()}"
    )


@app.command()
def show(variant: Annotated[str, typer.Argument(help="A variant id.")], as_json: AsJson = False) -> None:
    """Show what a variant changes, in numbers, and the policy that is shipped for it.

    Example: `imujoco show hopper-massdec_25_leggeom`
    """
    from imujoco_minari.envs.differences import differences

    parsed = Variant.parse(variant)
    changed = differences(parsed)
    record = expert_record(parsed)
    if as_json:
        print_json(
            {
                "variant": str(parsed),
                "environment": parsed.environment_id,
                "dataset": parsed.dataset_id(),
                "published": minari_root.exists(parsed.dataset_id()),
                "changes": [vars(difference) for difference in changed],
                "record": dict(record),
            }
        )
        return
    out.print(f"[bold]{parsed}[/]")
    out.print(f"environment  {parsed.environment_id}")
    published = minari_root.exists(parsed.dataset_id())
    out.print(
        f"dataset      {parsed.dataset_id()}  ({'published here' if published else 'not published here'})\n"
    )
    if changed:
        rows = [[d.quantity, f"{d.before:.6g}", f"{d.after:.6g}", d.unit] for d in changed]
        print_table(("changed", "base", "variant", "unit"), rows, numeric=("base", "variant"))
    else:
        out.print("nothing is changed: this is the robot of Gymnasium's v5 environment")
    out.print("")
    _print_record(record)


def _print_record(record: Any) -> None:
    if not record:
        out.print("no expert policy is shipped: `imujoco train` makes one")
        return
    evaluation, random = record["evaluation"], record.get("random")
    out.print(
        f"expert       {record['algorithm']}, {record['steps']:,} steps from {record['start']}, "
        f"seed {record['seed']}"
    )
    out.print(
        f"return       {evaluation['return_mean']:.1f} ± {evaluation['return_std']:.1f} "
        f"({evaluation['return_min']:.1f} to {evaluation['return_max']:.1f}) "
        f"over {evaluation['episodes']} episodes of {evaluation['length_mean']:.0f} steps"
    )
    if random:
        out.print(f"random       {random['return_mean']:.1f} over {random['episodes']} episodes")


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "-"
    return f"{value:+d}" if isinstance(value, int) else str(value)
