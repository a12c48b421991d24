"""Pictures and videos of variants, drawn off-screen.

:mod:`~imujoco_minari.pictures.rendering.motion` computes the motion, ``framing`` places the camera, ``scene``
sets colours and lights, ``studio`` draws, ``film`` arranges the pictures and ``files`` writes them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from imujoco_minari.pictures.rendering.files import check_format, write_picture, write_video
from imujoco_minari.pictures.rendering.film import (
    FRAMES_PER_SECOND,
    contact_sheet,
    frames,
    sheet_steps,
    stride,
)
from imujoco_minari.pictures.rendering.motion import Motion, perform, replay
from imujoco_minari.pictures.rendering.studio import Studio

__all__ = ["Motion", "Studio", "frame_steps", "perform", "render_motions", "replay"]

# A GIF stores every changed pixel, and few viewers can show more frames per second.
GIF_FRAMES_PER_SECOND = 12.5


def frame_steps(motions: Sequence[Motion], path: Path, *, sheet: bool = False) -> list[int]:
    """Return the steps that :func:`render_motions` draws into the file ``path``."""
    ending = check_format(path)
    longest = max(len(motion.positions) for motion in motions)
    if sheet:
        return sheet_steps(longest)
    if ending == ".png":
        return [(longest - 1) // 2]
    return list(range(0, longest, stride(motions, _frame_rate(path))))


def render_motions(
    motions: Sequence[Motion],
    path: Path,
    size: tuple[int, int] = (640, 480),
    *,
    sheet: bool = False,
    on_frame: Callable[[], None] | None = None,
) -> None:
    """Draw motions side by side into a file: a video, its middle frame, or a contact sheet.

    Args:
        motions: motions of variants of one robot. The cameras have the same distance.
        path: the file. It must end in ``.mp4``, ``.gif`` or ``.png``; ``.png`` is the middle frame.
        size: width and height of one motion's picture, in pixels.
        sheet: write a contact sheet. ``path`` must end in ``.png``.
        on_frame: called after each picture.

    Raises:
        RenderingError: if no OpenGL works or the ending is not valid.
        StorageError: if the file cannot be written.
        DependencyError: if ``imageio-ffmpeg``, which writes ``.mp4``, is not installed.

    Example:
        >>> variant = Variant.parse("hopper-massdec_25_leggeom")
        >>> motion = perform(variant, load_policy(variant), seconds=2.0)
        >>> render_motions([motion], Path("hopper.gif"))
    """
    steps = frame_steps(motions, path, sheet=sheet)
    with Studio(*size) as studio:
        pictures = frames(motions, studio, steps, on_frame=on_frame)
        if path.suffix.lower() != ".png":
            frame_seconds = stride(motions, _frame_rate(path)) * motions[0].timestep
            write_video(path, pictures, 1.0 / frame_seconds)
        elif sheet:
            write_picture(path, contact_sheet(list(pictures)))
        else:
            write_picture(path, next(pictures))


def _frame_rate(path: Path) -> float:
    return GIF_FRAMES_PER_SECOND if path.suffix.lower() == ".gif" else FRAMES_PER_SECOND
