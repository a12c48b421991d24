"""``imujoco plot`` and ``imujoco transfer``: figures of datasets, and of policies on other variants."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from imujoco_minari.cli.app import AsJson, Category, Robot, app, out, print_json, progress, say
from imujoco_minari.errors import VariantError


@app.command()
def plot(
    ids: Annotated[list[str], typer.Argument(metavar="ID...", help="Dataset ids, of one robot.")],
    folder: Annotated[Path, typer.Option("--out", "-o", help="Folder of the figures.")] = Path("plots"),
    as_json: AsJson = False,
) -> None:
    """Plot returns, episode lengths, actions and observations of datasets against the base robot's.

    The base robot's dataset of the same tier is drawn in grey, if it is published here.
    Each figure is written as PNG and as SVG.

    Example: `imujoco plot imujoco/hopper-massdec_25_leggeom-v0 --out plots`
    """
    from imujoco_minari.pictures.plotting.datasets import QUESTIONS, load_series, plot_datasets, with_bases

    names = list(dict.fromkeys(ids))
    with progress("plotting", len(names) + len(QUESTIONS), quiet=as_json) as advance:
        series = []
        for name in names:
            series.append(load_series(name))
            advance()
        drawn, missing = with_bases(series)
        files = plot_datasets(drawn, folder, on_figure=advance)
    for name in missing:
        say(f"without the base robot: {name} is not published here")
    if as_json:
        print_json({"files": [str(file) for file in files], "missing": missing})
        return
    out.print(f"wrote {len(files)} files to {folder}: " + ", ".join(file.name for file in files))


@app.command()
def transfer(
    robot: Robot = None,
    category: Category = None,
    policies: Annotated[
        list[Path] | None, typer.Option("--policy", help="A .zip or .safetensors; may be repeated.")
    ] = None,
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Episodes a cell.")] = 5,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Base seed of the episodes.")] = 0,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="How many processes.")] = 1,
    folder: Annotated[Path | None, typer.Option("--out", "-o", help="Folder of the results.")] = None,
    as_json: AsJson = False,
) -> None:
    """Evaluate every expert of a robot on every variant of it, and draw the matrix.

    Writes the heat map (PNG, SVG) and the numbers (CSV). A run that was broken off goes on.
    With --policy, the given policies are evaluated instead of the experts.

    Example: `imujoco transfer --robot hopper --category mass --jobs 2`
    """
    from imujoco_minari.pictures.plotting.style import new_figure
    from imujoco_minari.pictures.plotting.transfer import plot_transfer
    from imujoco_minari.policies import read_actor
    from imujoco_minari.policies.transfer import columns, evaluate_transfer, expert_policies, write_csv

    if robot is None:
        raise VariantError("name the robot with --robot")
    variants = columns(robot, category)
    chosen = (
        {path.stem: read_actor(path) for path in policies} if policies else expert_policies(robot, category)
    )
    # A missing matplotlib is told before the work, not after.
    new_figure(1.0, 1.0, "")
    target = folder or Path(f"transfer-{robot}")
    with progress("evaluating", len(chosen) * len(variants), quiet=as_json) as advance:
        result = evaluate_transfer(
            chosen,
            variants,
            target / "transfer.json",
            episodes=episodes,
            seed=seed,
            jobs=jobs,
            on_cell=advance,
        )
    write_csv(result, target / "transfer.csv")
    files = [target / "transfer.csv", *plot_transfer(result, target / "transfer")]
    if as_json:
        print_json(
            {
                "files": [str(file) for file in files],
                "policies": result.policies,
                "variants": [str(variant) for variant in result.variants],
                "returns": result.returns(),
            }
        )
        return
    out.print(
        f"{len(result.policies)} policies on {len(result.variants)} variants, {episodes} episodes each\n"
        + "wrote "
        + ", ".join(str(file) for file in files)
    )
