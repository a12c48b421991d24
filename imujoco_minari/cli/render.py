"""``imujoco render``: a variant, or a recorded episode of a dataset, as a video or a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from imujoco_minari.cli import options
from imujoco_minari.cli.app import app
from imujoco_minari.cli.estimates import size_text
from imujoco_minari.cli.options import argument, option
from imujoco_minari.cli.printing import counted, progress, report, say
from imujoco_minari.errors import RenderingError, StorageError
from imujoco_minari.variants import EXPERT, Variant


@app.command()
def render(
    what: Annotated[str, argument("VARIANT|ID", "A variant id, or a dataset id.")],
    episode: Annotated[
        int, option("--episode -e N", "The episode of a dataset; the seed of a variant.", min=0)
    ] = 0,
    target: options.Output = None,
    beside_base: Annotated[bool, option("--beside-base", "Show the base robot beside the variant.")] = False,
    sheet: Annotated[bool, option("--sheet", "Make a .png sheet of frames.")] = False,
    tier: Annotated[
        str | None, option("--tier -t TIER", "The policy that moves a variant. [default: expert]")
    ] = None,
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
    from imujoco_minari.pictures.rendering.source import of_dataset, of_variant

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
    with progress(str(target), count, quiet=as_json) as advance:
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
    lines.append(f"wrote {target}: {counted(count, 'frame')}, {size_text(target.stat().st_size)}")
    report({"path": target, "frames": count, "motions": facts}, *lines, as_json=as_json)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise RenderingError(f"malformed size {text!r}; valid: WIDTHxHEIGHT in pixels, as in 640x480")
    if not (64 <= int(width) <= 4096 and 64 <= int(height) <= 4096):
        raise RenderingError(f"size {text} cannot be drawn; valid: 64 to 4096 pixels each way")
    return int(width), int(height)
