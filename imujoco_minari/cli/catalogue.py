"""``imujoco list`` and ``imujoco show``: the variants, and the numbers that each of them changes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from imujoco_minari.cli import options
from imujoco_minari.cli.app import app
from imujoco_minari.cli.printing import out, print_json, print_table, say
from imujoco_minari.cli.selection import Filters, counted_variants
from imujoco_minari.errors import PolicyError, PolicyNotFoundError, VariantError
from imujoco_minari.policies import expert_record, expert_variants, universal_policy
from imujoco_minari.policies.experts import is_folded, start_of
from imujoco_minari.policies.standing import share_of_base
from imujoco_minari.storage import minari_root
from imujoco_minari.variants import EXPERT, NAMESPACE, Variant, parse_dataset_id


@app.command("list")
def list_variants(
    robot: options.Robot = None,
    category: options.Category = None,
    with_base: options.WithBase = False,
    as_json: options.AsJson = False,
) -> None:
    """List the variants of the catalogue.

    It shows which expert each variant has: its own, or the universal policy of the robot, folded. It shows
    which tiers of each variant are in the Minari root. Other commands with the same filters work on
    the variants that it lists: `imujoco list --robot hopper` lists those that `imujoco publish --robot
    hopper` publishes. It lists the base robots only with --with-base.

    Examples: `imujoco list`, `imujoco list --robot hopper --category length`, `imujoco list --with-base`
    """
    chosen = Filters(robot, category, with_base=with_base).variants()
    experts, tiers = set(expert_variants()), _published_tiers()
    told = {robot for robot in {variant.robot for variant in chosen} if _has_universal(robot)}
    rows: list[dict[str, Any]] = [
        {
            "variant": str(variant),
            "robot": variant.robot,
            "category": variant.category,
            "body": variant.body,
            "percent": variant.percent,
            "policy": "own" if variant in experts else "folded" if variant.robot in told else None,
            "published": tiers.get(variant, []),
        }
        for variant in chosen
    ]
    if as_json:
        print_json(rows)
        return
    columns = ("variant", "category", "body", "percent", "policy", "published")
    print_table(columns, [[_cell(row[column]) for column in columns] for row in rows], numeric=("percent",))
    out.print(
        "",
        f"{counted_variants(chosen)}; {sum(row['policy'] is not None for row in rows)} with an expert, "
        f"{sum(bool(row['published']) for row in rows)} published in {minari_root.datasets_root()}",
    )


def _has_universal(robot: str) -> bool:
    """Return whether a robot has a universal policy. One that cannot be read is named."""
    try:
        return universal_policy(robot) is not None
    except (PolicyError, PolicyNotFoundError) as error:
        say(f"note: left out: {error}")
        return False


def _published_tiers() -> dict[Variant, list[str]]:
    """Return the tiers of each variant that are in the Minari root, the expert's first."""
    tiers: dict[Variant, list[str]] = {}
    for folder in minari_root.datasets_root().glob(f"{NAMESPACE}/*-v0"):
        try:
            variant, tier = parse_dataset_id(f"{NAMESPACE}/{folder.name}")
        except VariantError:
            continue
        tiers.setdefault(variant, []).append(tier)
    return {
        variant: sorted(found, key=lambda tier: (tier != EXPERT, tier)) for variant, found in tiers.items()
    }


@app.command()
def show(variant: options.VariantId, as_json: options.AsJson = False) -> None:
    """Show what a variant changes, in numbers, and its policy.

    Example: `imujoco show hopper-massdec_25_leggeom`
    """
    from imujoco_minari.envs.differences import differences

    parsed = Variant.parse(variant)
    changed = differences(parsed)
    record = expert_record(parsed)
    tiers = _published_tiers().get(parsed, [])
    if as_json:
        print_json(
            {
                "variant": str(parsed),
                "environment": parsed.environment_id,
                "dataset": parsed.dataset_id(),
                "published": tiers,
                "changes": [vars(difference) for difference in changed],
                "record": record,
            }
        )
        return
    published = f"published here: {', '.join(tiers)}" if tiers else "not published here"
    out.print(str(parsed), style="bold")
    out.print(f"environment  {parsed.environment_id}")
    out.print(f"dataset      {parsed.dataset_id()}  ({published})", "")
    if changed:
        rows = [[d.quantity, f"{d.before:.6g}", f"{d.after:.6g}", d.unit] for d in changed]
        print_table(("changed", "base", "variant", "unit"), rows, numeric=("base", "variant"))
    else:
        out.print("nothing is changed: this is the robot of Gymnasium's v5 environment")
    out.print("")
    _print_record(record)


def _print_record(record: Mapping[str, Any]) -> None:
    if not record:
        out.print("no expert policy is shipped: `imujoco train` makes one")
        return
    if is_folded(record):
        out.print(
            f"expert       {record['algorithm']}, the universal policy, told this variant; no own training"
        )
    evaluation, random = record.get("evaluation"), record.get("random")
    if evaluation is None:
        out.print("return       not measured yet: `imujoco publish` and `imujoco_minari.evaluate` measure it")
        return
    if not is_folded(record):
        made = f"{start_of(record)}, not trained further"
        if record["steps"]:
            made = f"{record['steps']:,} steps from {start_of(record)}, seed {record['seed']}"
        out.print(f"expert       {record['algorithm']}, {made}")
    out.print(
        f"return       {evaluation['return_mean']:.1f} ± {evaluation['return_std']:.1f} "
        f"({evaluation['return_min']:.1f} to {evaluation['return_max']:.1f}) "
        f"over {evaluation['episodes']} episodes of {evaluation['length_mean']:.0f} steps"
    )
    if (share := share_of_base(record)) is not None:
        out.print(f"of the base  {share:.2f}")
    if random:
        out.print(f"random       {random['return_mean']:.1f} over {random['episodes']} episodes")


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, list):
        return ", ".join(value) or "-"
    return f"{value:+g}" if isinstance(value, int | float) else str(value)
