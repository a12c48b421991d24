"""``imujoco render``, ``plot``, ``transfer`` and ``gallery``: videos, figures and a site of the variants."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import filesize

from imujoco_minari.cli import options
from imujoco_minari.cli.app import FAILED, app
from imujoco_minari.cli.estimates import gallery_line
from imujoco_minari.cli.options import argument, option
from imujoco_minari.cli.printing import counted, fail, progress, report, say, with_name
from imujoco_minari.cli.selection import VariantChoice, counted_variants
from imujoco_minari.errors import RenderingError, StorageError, TransferError, VariantError
from imujoco_minari.variants import EXPERT, Variant

if TYPE_CHECKING:
    from imujoco_minari.policies import Policy


@app.command()
def render(
    what: Annotated[str, argument("VARIANT|ID", "A variant id, or a dataset id.")],
    episode: Annotated[int, option("--episode -e N", "A dataset's episode, or a variant's seed.", min=0)] = 0,
    target: options.Output = None,
    beside_base: Annotated[bool, option("--beside-base", "Show the base robot beside the variant.")] = False,
    sheet: Annotated[bool, option("--sheet", "Make a .png sheet of frames.")] = False,
    tier: Annotated[str | None, option("--tier -t TIER", "A variant's policy. [default: expert]")] = None,
    policy: options.PolicyFile = None,
    seconds: Annotated[
        float | None, option("--seconds X", "Show this much of the episode instead of all.", min=0.1)
    ] = None,
    size: Annotated[str, option("--size WxH", "Width and height in pixels.")] = "640x480",
    force: options.Force = False,
    as_json: options.AsJson = False,
) -> None:
    """Render a variant or a recorded episode.

    A variant is moved by its policy; a recorded episode is replayed exactly. It needs no screen. A colour
    shows what the variant changes: orange for mass, blue for joint, green for length, purple for friction.
    --output is a .mp4, .gif or .png file; a .png without --sheet shows the middle of the episode.

    Examples: `imujoco render hopper-lengthinc_50_leggeom --beside-base --tier random`,
    `imujoco render imujoco/hopper-massdec_25_leggeom-v0 --episode 3 --output episode.mp4`
    """
    from imujoco_minari.pictures.rendering import frame_steps, render_motions
    from imujoco_minari.pictures.rendering.files import check_format
    from imujoco_minari.pictures.rendering.motion import of_dataset, of_variant

    width, height = _size(size)
    if target is None:
        name = what.rpartition("/")[2] + ("" if "/" not in what else f"-episode{episode}")
        target = Path(f"{name}.{'png' if sheet else 'mp4'}")
    if check_format(target) != ".png" and sheet:
        raise RenderingError(f"a sheet is one picture: give --output a .png, not {str(target)!r}")
    if target.exists() and not force:
        raise StorageError(f"{target} is already there; it was left alone (--force replaces it)")
    if "/" in what:
        if tier is not None or policy is not None:
            raise RenderingError(f"{what} is a dataset: it is replayed, so leave out --tier and --policy")
        motions = of_dataset(what, episode, beside_base=beside_base, seconds=seconds)
    else:
        variant = Variant.parse(what)
        motions = of_variant(
            variant, tier or EXPERT, policy, seed=episode, beside_base=beside_base, seconds=seconds
        )
    for motion in motions:
        if motion.divergence > 0:
            say(
                f"{motion.variant}: the replay differs from the recording by up to {motion.divergence:.3g}: "
                "another version of MuJoCo made it (see `imujoco verify`)"
            )
    count = len(frame_steps(motions, target, sheet=sheet))
    with progress(str(target), count) as advance:
        render_motions(motions, target, (width, height), sheet=sheet, on_frame=advance)
    facts: list[dict[str, Any]] = [
        {
            "variant": str(motion.variant),
            "moved_by": motion.title,
            "steps": len(motion.rewards),
            "seconds": motion.duration,
            "return": motion.total,
            "terminated": motion.terminated,
            "divergence": motion.divergence,
        }
        for motion in motions
    ]
    lines = [
        "{variant}: {moved_by}, {steps} steps, {seconds:.1f} s, return {return:.1f}".format(**motion)
        for motion in facts
    ]
    lines.append(f"wrote {target}: {counted(count, 'frame')}, {filesize.decimal(target.stat().st_size)}")
    report({"path": target, "frames": count, "motions": facts}, *lines, as_json=as_json)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if width.isdecimal() and height.isdecimal():
        size = int(width), int(height)
        if all(64 <= side <= 4096 for side in size):
            return size
    raise RenderingError(f"wrong size {text!r}; valid: WIDTHxHEIGHT, 64 to 4096 pixels each, as in 640x480")


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

    folder = _folder(output, "plots")
    names = list(dict.fromkeys(ids))
    with progress("plotting", len(names) + len(FIGURES)) as advance:
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


def _folder(output: Path | None, default: str) -> Path:
    """Return the folder that a command writes several files into. The name of a picture is an error."""
    if output is not None and output.suffix in (".png", ".svg", ".pdf"):
        raise RenderingError(f"several files are written: give --output a folder, not {str(output)!r}")
    return output or Path(default)


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
    target = _folder(output, f"transfer-{robot}")
    variants = columns(robot, category)
    chosen = _read_policies(policies) if policies else expert_policies(robot, category)
    with new_figure(1.0, 1.0, ""):
        # A missing matplotlib is reported before the work, not after it.
        pass
    state = target / "transfer.json"
    with progress("evaluating", len(chosen) * len(variants)) as advance:
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


@app.command()
def gallery(
    folder: Annotated[Path, argument("FOLDER", "Folder of the site.")],
    variants: options.VariantIds = None,
    robot: options.Robot = None,
    category: options.Category = None,
    results: Annotated[Path | None, option("--results FOLDER", "Show the few-shot scores in FOLDER.")] = None,
    as_json: options.AsJson = False,
) -> None:
    """Build a static website of the variants.

    It shows clips, numbers, returns and code. Without ids and filters, it shows the whole catalogue. The
    base robots are always shown too, for comparison. The site works from a folder and from any web host. A
    second run in the same folder draws only what is new or has changed, so an interrupted run can be
    continued.

    Examples: `imujoco gallery site`, `imujoco gallery site --robot hopper --category length`,
    `imujoco gallery site --results results`
    """
    from imujoco_minari.benchmark.page import read_results
    from imujoco_minari.benchmark.tables import variant_tables
    from imujoco_minari.pictures.gallery.builder import build, steps

    start = time.monotonic()
    tables = variant_tables(read_results(results).few_shot) if results else {}
    everything = not (variants or robot or category)
    chosen = VariantChoice(robot, category, everything, names=variants).variants()
    count = steps(folder, chosen)
    if len(chosen) > 1:
        say(gallery_line(count))
    with progress("drawing", count) as advance:
        built = build(folder, chosen, results=tables, on_variant=advance)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    result = {
        "index": str(folder / "index.html"),
        "variants": built.variants,
        "drawn": built.drawn,
        "failed": built.failed,
        "bytes": size,
        "seconds": time.monotonic() - start,
    }
    line = (
        f"wrote {result['index']}: {built.variants} variants and bases, {built.drawn} drawn anew, "
        f"{filesize.decimal(size)}, in {result['seconds']:.0f} s"
    )
    report(result, line, as_json=as_json)
    for variant, reason in built.failed.items():
        fail(with_name(variant, reason))
    if built.failed:
        raise typer.Exit(FAILED)
