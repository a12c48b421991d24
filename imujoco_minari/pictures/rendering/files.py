"""Writes pictures and videos to files: MP4 with the ffmpeg of ``imageio-ffmpeg``, GIF and PNG with Pillow."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

from PIL import Image

from imujoco_minari.errors import RenderingFormatError, missing_dependency
from imujoco_minari.pictures.rendering.film import grid
from imujoco_minari.storage.files import whole_file

FORMATS = (".mp4", ".gif", ".png")


def check_format(path: Path) -> str:
    """Return the lower-case ending of ``path``.

    Raises:
        RenderingFormatError: if the ending is not one of :data:`FORMATS`.
        DependencyError: if ``imageio-ffmpeg``, which writes ``.mp4``, is not installed.
    """
    ending = path.suffix.lower()
    if ending not in FORMATS:
        raise RenderingFormatError(f"cannot write {str(path)!r}; valid endings: {', '.join(FORMATS)}")
    if ending == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError:
            raise missing_dependency("imageio-ffmpeg", "render", "writing .mp4") from None
    return ending


def write_video(path: Path, pictures: Iterable[Image.Image], per_second: float, *, quality: int = 23) -> None:
    """Write pictures of one size, at least one, as an ``.mp4`` (H.264) or a ``.gif``.

    For ``.mp4``, an odd width or height is cut by one pixel, and ``quality`` is H.264's constant rate factor:
    a lower value is a better picture and a larger file.
    """
    ending = check_format(path)
    with whole_file(path) as partial:
        if ending == ".mp4":
            _write_mp4(partial, iter(pictures), per_second, quality)
        else:
            _write_gif(partial, iter(pictures), per_second)


def write_picture(path: Path, picture: Image.Image) -> None:
    """Write one picture in the format of the path's ending."""
    with whole_file(path) as partial:
        picture.save(partial, optimize=True)


def _write_mp4(path: Path, pictures: Iterator[Image.Image], per_second: float, quality: int) -> None:
    import imageio_ffmpeg

    # A folder that cannot be written is found here: ffmpeg's own error is a page long.
    path.touch()
    first = next(pictures)
    # H.264's usual colour format halves the resolution of colour, so it requires even sizes.
    width, height = first.width // 2 * 2, first.height // 2 * 2
    writer = imageio_ffmpeg.write_frames(
        str(path),
        (width, height),
        fps=per_second,
        codec="libx264",
        quality=None,
        macro_block_size=2,
        output_params=["-crf", str(quality), "-preset", "medium", "-movflags", "+faststart"],
    )
    writer.send(None)
    try:
        for picture in chain((first,), pictures):
            try:
                writer.send(picture.crop((0, 0, width, height)).tobytes())
            except OSError:
                raise OSError("ffmpeg ended early; is the disk full?") from None
    finally:
        writer.close()


def _write_gif(path: Path, pictures: Iterator[Image.Image], per_second: float) -> None:
    drawn = list(pictures)
    # All frames share one palette. One palette per frame flickers and doubles the size.
    sample = grid(drawn[:: max(1, len(drawn) // 4)], columns=1)
    palette = sample.quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    reduced = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in drawn]
    reduced[0].save(path, save_all=True, append_images=reduced[1:], duration=round(1000 / per_second), loop=0)
