"""Frames of motions side by side, with captions, for a video or a contact sheet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from itertools import repeat
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from imujoco_minari.envs.categories import BY_NAME
from imujoco_minari.pictures.rendering.framing import Camera, capsules, follow
from imujoco_minari.pictures.rendering.motion import Motion
from imujoco_minari.pictures.rendering.scene import COLOURS
from imujoco_minari.pictures.rendering.studio import Studio
from imujoco_minari.variants import Variant

FRAMES_PER_SECOND = 25.0
INK, FAINT, PAPER = (28, 32, 38), (96, 104, 114), (255, 255, 255)
# The gap between two panels in pixels. It is twice as wide between the pictures of a sheet.
GAP = 4
# The heights of caption and text as shares of a panel's height.
CAPTION, TEXT = 0.125, 0.045
# Number of pictures on a contact sheet. A short motion has fewer.
SHEET = 12


def stride(motions: Sequence[Motion], per_second: float = FRAMES_PER_SECOND) -> int:
    """Return the steps between two frames, for about ``per_second`` frames a second in real time."""
    return max(1, round(1.0 / (per_second * motions[0].timestep)))


def frames(
    motions: Sequence[Motion],
    studio: Studio,
    steps: Sequence[int],
    *,
    captions: bool = True,
    on_frame: Callable[[], None] | None = None,
) -> Iterator[Image.Image]:
    """Yield a picture of all motions side by side for each of the environment's steps, which ascend.

    A motion that ended before a step shows its last position, and its caption shows the time of the end.
    ``on_frame`` is called after each picture.
    """
    seen = [capsules(studio.model(motion.variant, motion.mjcf), motion.positions) for motion in motions]
    cameras = follow(seen, studio.aspect, motions[0].timestep)
    panels = [
        _draw_panel(motion, camera, studio, steps, captions)
        for motion, camera in zip(motions, cameras, strict=True)
    ]
    for pictures in zip(*panels, strict=True):
        picture = grid(pictures, len(pictures), GAP)
        if on_frame is not None:
            on_frame()
        yield picture


def sheet_steps(positions: int) -> list[int]:
    """Return the steps on a contact sheet, evenly spaced from the first position to the last."""
    return [int(step) for step in np.unique(np.linspace(0, positions - 1, SHEET).round())]


def contact_sheet(pictures: Sequence[Image.Image]) -> Image.Image:
    """Return a contact sheet with four pictures per row, or with two if each shows two robots."""
    wide = pictures[0].width > 2 * pictures[0].height
    return grid(pictures, 2 if wide else 4)


def grid(pictures: Sequence[Image.Image], columns: int, gap: int = 2 * GAP) -> Image.Image:
    """Return pictures of equal size in rows of ``columns``, with ``gap`` white pixels between two."""
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    width, height = pictures[0].size
    pitch = width + gap, height + gap
    whole = Image.new("RGB", (columns * pitch[0] - gap, rows * pitch[1] - gap), PAPER)
    for number, picture in enumerate(pictures):
        whole.paste(picture, (number % columns * pitch[0], number // columns * pitch[1]))
    return whole


def changes_in_words(variant: Variant) -> str:
    """Return what a variant changes, in a few words."""
    parts = [f"{BY_NAME[each.category].noun} of {each.body} {each.percent:+g} %" for each in variant.changes]
    return ", ".join(parts) or "unchanged"


def caption_height(height: int) -> int:
    """Return the height in pixels of the caption over a panel. It is even, as video codecs require."""
    return 2 * round(height * CAPTION / 2)


def _draw_panel(
    motion: Motion, camera: Camera, studio: Studio, steps: Sequence[int], captions: bool
) -> Iterator[Image.Image]:
    last = len(motion.positions) - 1
    # The last position of an ended motion is drawn once and repeated.
    shown, times = np.unique(np.minimum(steps, last), return_counts=True)
    places = Camera(camera.lookat[shown], camera.distance)
    earned = np.concatenate([[0.0], np.cumsum(motion.rewards)])
    pictures = studio.shoot(motion.variant, motion.positions[shown], places, motion.mjcf)
    for step, count, picture in zip(shown, times, pictures, strict=True):
        over = step == last and motion.terminated
        if over:
            picture = Image.blend(picture, Image.new("RGB", picture.size, PAPER), 0.35)
        if captions:
            time = step * motion.timestep
            state = f"{'ended at' if over else 't ='} {time:.2f} s    return {earned[step]:.0f}"
            picture = captioned(picture, motion.variant, motion.title, state)
        yield from repeat(picture, count)


def captioned(picture: Image.Image, variant: Variant, title: str = "", state: str = "") -> Image.Image:
    """Return a picture with a caption above it.

    A variant's id and what it changes are on the left, ``title`` and below it ``state`` on the right.
    """
    strip, size = caption_height(picture.height), picture.height * TEXT
    whole = Image.new("RGB", (picture.width, picture.height + strip), PAPER)
    whole.paste(picture, (0, strip))
    draw = ImageDraw.Draw(whole)
    colour = COLOURS.get(variant.category)
    ink = FAINT if colour is None else tuple(round(170 * part) for part in colour)
    margin, smaller = size / 2, 0.85 * size
    for height, left, left_ink, right, right_ink in (
        (0.08 * strip, str(variant), INK, title, FAINT),
        (0.52 * strip, changes_in_words(variant), ink, state, INK),
    ):
        # A line that is wider than the picture is shrunk, but stays readable.
        width = _font(size).getlength(left) + size + _font(smaller).getlength(right)
        scale = min(1.0, max(6.0 / size, (picture.width - size) / width))
        draw.text((margin, height), left, left_ink, _font(scale * size))
        draw.text((picture.width - margin, height), right, right_ink, _font(scale * smaller), "ra")
    return whole


@lru_cache(maxsize=16)
def _font(size: float) -> Any:
    return ImageFont.load_default(size)
