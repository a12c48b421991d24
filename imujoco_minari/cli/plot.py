"""``imujoco plot`` and ``imujoco transfer``: figures of datasets, and of policies on other variants."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from imujoco_minari.cli import options
from imujoco_minari.cli.app import app
from imujoco_minari.cli.options import option
from imujoco_minari.cli.printing import counted, progress, report, say
from imujoco_minari.cli.selection import counted_variants
from imujoco_minari.errors import TransferError, VariantError

if TYPE_CHECKING:
    from imujoco_minari.policies import Policy


@app.command()
def plot(
    ids: options.DatasetIds,
    output: options.Output = None,
    as_json: options.AsJson = False,
) -> None:
    """Plot datasets against the base robot's.

    It plots returns, episode lengths, actions and observations. The datasets are of one robot. The base
    robot's dataset of the same tier is drawn in grey, if it is in the Minari root. Each figure is written
    as PNG and as SVG, into the folder `plots` unless --output names another.

    Example: `imujoco plot imujoco/hopper-massdec_25_leggeom-v0 --output figures`
    """
    from imujoco_minari.pictures.plotting.datasets import FIGURES, load_series, plot_datasets, with_bases

    folder = output or Path("plots")
    names = list(dict.fromkeys(ids))
    with progress("plotting", len(names) + len(FIGURES), quiet=as_json) as advance:
        series = []
        for name in names:
            series.append(load_series(name))
            advance()
        drawn, missing = with_bases(series)
        files = plot_datasets(drawn, folder, on_figure=advance)
    for name in missing:
        say(f"the base robot is not drawn: {name} is not in the Minari root")
    line = f"wrote {counted(len(files), 'file')} to {folder}: {', '.join(file.name for file in files)}"
    report({"files": files, "missing": missing}, line, as_json=as_json)


@app.command()
def transfer(
    robot: options.Robot = None,
    category: options.Category = None,
    policies: Annotated[
        list[Path] | None, option("--policy FILE", "A .zip or .safetensors; may be repeated.")
    ] = None,
    episodes: options.EpisodeCount = 5,
    seed: options.Seed = 0,
    jobs: options.Jobs = 1,
    output: options.Output = None,
    as_json: options.AsJson = False,
) -> None:
    """Evaluate every expert of a robot on every variant.

    The base robot counts as a variant. The command writes a heat map (PNG, SVG) and the numbers (CSV), into
    the folder `transfer-<robot>` unless --output names another. An interrupted run continues where it
    stopped. --episodes is the number for each policy and variant. With --policy, the given policies are
    evaluated instead of the experts.

    Examples: `imujoco transfer --robot hopper --category mass --jobs 2`,
    `imujoco transfer --robot hopper --policy sac.zip --episodes 20`
    """
    from imujoco_minari.pictures.plotting.style import new_figure
    from imujoco_minari.pictures.plotting.transfer import plot_transfer
    from imujoco_minari.policies.transfer import columns, evaluate_transfer, expert_policies, write_csv

    if robot is None:
        raise VariantError("name the robot with --robot")
    variants = columns(robot, category)
    chosen = _read_policies(policies) if policies else expert_policies(robot, category)
    with new_figure(1.0, 1.0, ""):
        # A missing matplotlib is reported before the work, not after it.
        pass
    target = output or Path(f"transfer-{robot}")
    state = target / "transfer.json"
    with progress("evaluating", len(chosen) * len(variants), quiet=as_json) as advance:
        result = evaluate_transfer(
            chosen, variants, state, episodes=episodes, seed=seed, jobs=jobs, on_cell=advance
        )
    write_csv(result, target / "transfer.csv")
    files = [target / "transfer.csv", *plot_transfer(result, target / "transfer")]
    document = {
        "files": files,
        "policies": result.policies,
        "variants": result.variants,
        "returns": result.returns(),
    }
    line = f"{counted(len(result.policies), 'policy')} on {counted_variants(result.variants)}, "
    line += f"{counted(episodes, 'episode')} each"
    report(document, line, f"wrote {', '.join(map(str, files))}", as_json=as_json)


def _read_policies(paths: list[Path]) -> dict[str, Policy]:
    """Return the policies of files by the names of the files.

    Raises:
        TransferError: if two files have the same name, whatever their folders and endings.
    """
    from imujoco_minari.policies import read_actor

    files: dict[str, Path] = {}
    for path in paths:
        if files.setdefault(path.stem, path) != path:
            raise TransferError(
                f"{files[path.stem]} and {path} have the same name, {path.stem}: rename one of the files"
            )
    return {name: read_actor(path) for name, path in files.items()}
