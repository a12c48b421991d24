"""Motions side by side, with a caption each: the frames of a video, or a contact sheet of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import repeat

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from imujoco_minari.pictures.rendering.framing import Camera, capsules, follow
from imujoco_minari.pictures.rendering.motion import Motion
from imujoco_minari.pictures.rendering.scene import COLOURS
from imujoco_minari.pictures.rendering.studio import Studio
from imujoco_minari.variants import BASE, Variant

FRAMES_PER_SECOND = 25.0
INK, FAINT, PAPER = (28, 32, 38), (96, 104, 114), (255, 255, 255)
# Pixels between two panels, and the heights of caption and text as shares of a panel's height.
GAP, CAPTION, TEXT = 4, 0.125, 0.045
# Pictures on a contact sheet.
SHEET = 12


@dataclass(frozen=True)
class Pace:
    """How a motion becomes frames: every ``stride``-th step, so that time runs as it did.

    Attributes:
        stride: environment steps between two frames.
        per_second: frames a second.
    """

    stride: int
    per_second: float


def pace(motions: Sequence[Motion], per_second: float = FRAMES_PER_SECOND) -> Pace:
    """Return the pace nearest to ``per_second`` at which time runs true."""
    timestep = motions[0].timestep
    stride = max(1, round(1.0 / (per_second * timestep)))
    return Pace(stride, 1.0 / (stride * timestep))


def cameras(motions: Sequence[Motion], studio: Studio) -> list[Camera]:
    """Return a camera a motion with a place for each of its positions, all at one distance."""
    seen = [capsules(studio.model(motion.variant, motion.mjcf), motion.positions) for motion in motions]
    return follow(seen, studio.aspect, motions[0].timestep)


def frames(
    motions: Sequence[Motion],
    studio: Studio,
    steps: Sequence[int],
    *,
    captions: bool = True,
    on_frame: Callable[[], None] | None = None,
) -> Iterator[Image.Image]:
    """Yield a picture of all motions side by side for each step number in ``steps``, which rise.

    A motion that is over before a step stands still, and its caption says when it ended.
    """
    panels = [
        _panel(motion, camera, studio, steps, captions)
        for motion, camera in zip(motions, cameras(motions, studio), strict=True)
    ]
    for pictures in zip(*panels, strict=True):
        picture = _beside(pictures)
        if on_frame is not None:
            on_frame()
        yield picture


def sheet_steps(positions: int, count: int = SHEET) -> list[int]:
    """Return ``count`` step numbers, evenly spaced from the first of ``positions`` to the last."""
    return [int(step) for step in np.unique(np.linspace(0, positions - 1, count).round())]


def contact_sheet(pictures: Sequence[Image.Image]) -> Image.Image:
    """Return a contact sheet: four pictures a row, or two where each shows two robots."""
    wide = pictures[0].width > 2 * pictures[0].height
    return grid(pictures, 2 if wide else 4)


def grid(pictures: Sequence[Image.Image], columns: int) -> Image.Image:
    """Return pictures of one size in rows of ``columns``, on white."""
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    width, height = pictures[0].size
    pitch = width + 2 * GAP, height + 2 * GAP
    whole = Image.new("RGB", (columns * pitch[0] - 2 * GAP, rows * pitch[1] - 2 * GAP), PAPER)
    for number, picture in enumerate(pictures):
        whole.paste(picture, (number % columns * pitch[0], number // columns * pitch[1]))
    return whole


def change(variant: Variant) -> str:
    """Return what a variant changes, in words."""
    if variant.category == BASE:
        return "the unchanged robot"
    what = {"joint": "range of"}.get(variant.category, f"{variant.category} of")
    return f"{what} {', '.join(variant.mjcf_names) or variant.body} {variant.percent:+d} %"


def caption_height(height: int) -> int:
    """Return the height of the caption over a panel of ``height``, in pixels, even as video wants it."""
    return 2 * round(height * CAPTION / 2)


def _panel(
    motion: Motion, camera: Camera, studio: Studio, steps: Sequence[int], captions: bool
) -> Iterator[Image.Image]:
    last = len(motion.positions) - 1
    # A motion that is over is drawn once more, not once a frame.
    moving = [step for step in steps if step < last]
    shown = moving + [last] * (len(steps) > len(moving))
    places = Camera(camera.lookat[shown], camera.distance)
    earned = np.concatenate([[0.0], np.cumsum(motion.rewards)])
    positions = [motion.positions[step] for step in shown]
    shots = studio.shoot(motion.variant, positions, places, motion.mjcf)
    for step, shot in zip(shown, shots, strict=True):
        picture = Image.fromarray(np.ascontiguousarray(shot))
        over = step == last and motion.terminated
        if over:
            picture = Image.blend(picture, Image.new("RGB", picture.size, PAPER), 0.35)
        if captions:
            time = step * motion.timestep
            state = f"{'ended at' if over else 't ='} {time:.2f} s    return {earned[step]:.0f}"
            picture = captioned(picture, motion.variant, motion.title, state)
        yield from repeat(picture, len(steps) - len(moving) if step == last else 1)


def captioned(picture: Image.Image, variant: Variant, title: str = "", state: str = "") -> Image.Image:
    """Return a picture under a caption: the variant, what it changes, and at the right what is given."""
    strip, size = caption_height(picture.height), picture.height * TEXT
    whole = Image.new("RGB", (picture.width, picture.height + strip), PAPER)
    whole.paste(picture, (0, strip))
    draw = ImageDraw.Draw(whole)
    colour = COLOURS.get(variant.category)
    ink = FAINT if colour is None else tuple(round(170 * part) for part in colour)
    margin, above, below = size * 0.5, strip * 0.08, strip * 0.52
    room, right = picture.width - 2 * margin, picture.width - margin
    for height, left_text, left_ink, right_text, right_ink in (
        (above, str(variant), INK, title, FAINT),
        (below, change(variant), ink, state, INK),
    ):
        width = _write(draw, (margin, height), left_text, left_ink, size, room)
        _write(draw, (right, height), right_text, right_ink, size * 0.85, room - width, right=True)
    return whole


def _write(
    draw: ImageDraw.ImageDraw,
    place: tuple[float, float],
    text: str,
    ink: tuple[int, ...],
    size: float,
    room: float,
    *,
    right: bool = False,
) -> float:
    """Write a line, smaller where ``room`` pixels would not hold it, and return its width."""
    font = ImageFont.load_default(size)
    width = draw.textlength(text, font=font)
    if width > room > 0:
        font = ImageFont.load_default(max(6.0, size * room / width))
        width = draw.textlength(text, font=font)
    draw.text((place[0] - width if right else place[0], place[1]), text, fill=ink, font=font)
    return width + size


def _beside(pictures: Sequence[Image.Image]) -> Image.Image:
    if len(pictures) == 1:
        return pictures[0]
    width = sum(picture.width for picture in pictures) + GAP * (len(pictures) - 1)
    whole = Image.new("RGB", (width, pictures[0].height), PAPER)
    left = 0
    for picture in pictures:
        whole.paste(picture, (left, 0))
        left += picture.width + GAP
    return whole
