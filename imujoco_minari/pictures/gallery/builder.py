"""Builds the site of the gallery, one variant after the other.

The site's ``gallery.json`` lists its variants and the keys of their pictures. It is written after each
variant, so an interrupted run continues where it stopped.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from imujoco_minari.envs.differences import differences
from imujoco_minari.errors import ImujocoError, RenderingError, StorageError
from imujoco_minari.pictures.gallery import clips
from imujoco_minari.pictures.gallery.entries import Clip, Entry, ResultTable, scores
from imujoco_minari.pictures.gallery.pages import index_page, variant_page
from imujoco_minari.pictures.rendering.files import check_format
from imujoco_minari.pictures.rendering.studio import Studio
from imujoco_minari.short_repr import short_repr
from imujoco_minari.storage.files import write_json, write_text
from imujoco_minari.variants import Variant, catalogue, known_robots

STATE = "gallery.json"
FORMAT = 2


@dataclass(frozen=True)
class Built:
    """The outcome of a run.

    Attributes:
        folder: folder of the site. Its first page is ``index.html``.
        variants: number of variants in the site, bases included.
        drawn: number of variants that this run drew.
        failed: maps each variant that is not in the site to the reason.
    """

    folder: Path
    variants: int
    drawn: int
    failed: dict[str, str]

    __repr__ = short_repr


def build(
    folder: Path,
    variants: Sequence[Variant],
    *,
    results: Mapping[str, Sequence[ResultTable]] | None = None,
    on_variant: Callable[[], None] | None = None,
) -> Built:
    """Build or update a site. It keeps its variants and gets ``variants`` and their base robots.

    Args:
        folder: a new or empty folder, or a site of an earlier run.
        variants: the variants to add or to update.
        results: maps variants to tables of results, which their pages show.
        on_variant: called after each variant.

    Raises:
        StorageError: if the folder has other content or cannot be written.
        RenderingError: if no OpenGL works.
        DependencyError: if ``imageio-ffmpeg``, which writes the clips, is not installed.
    """
    check_format(Path("clip.mp4"))
    state = _read_state(folder)
    order = _sort_by_catalogue(_site_variants(variants, state))
    entries, failed, drawn = [], {}, 0
    with Studio(*clips.SIZE, fine=False) as studio:
        # Before the first picture, so that a run which ends early can be continued.
        write_json(folder / STATE, state)
        for variant in order:
            known = state["variants"].setdefault(str(variant), {})
            try:
                drawn += clips.draw(variant, folder, studio, known)
                clip = Clip(**known["clip"])
                entry = Entry(variant, tuple(differences(variant)), scores(variant), clip)
            except (RenderingError, StorageError):
                # These errors would stop every variant.
                raise
            except ImujocoError as error:
                failed[str(variant)] = str(error)
                del state["variants"][str(variant)]
            else:
                entries.append(entry)
                write_json(folder / STATE, state)
            if on_variant is not None:
                on_variant()
    _write_pages(folder, entries, results or {})
    return Built(folder, len(entries), drawn, failed)


def steps(folder: Path, variants: Sequence[Variant]) -> int:
    """Return the number of calls of ``on_variant`` that :func:`build` will make."""
    return len(_site_variants(variants, _read_state(folder)))


def _write_pages(
    folder: Path, entries: Sequence[Entry], results: Mapping[str, Sequence[ResultTable]]
) -> None:
    by_variant = {entry.variant: entry for entry in entries}
    order = [None, *by_variant, None]
    for entry, neighbours in zip(entries, zip(order[:-2], order[2:], strict=True), strict=True):
        name = str(entry.variant)
        text = variant_page(entry, by_variant.get(entry.variant.base), neighbours, results.get(name, ()))
        write_text(folder / "variants" / f"{name}.html", text)
    for name in ("style.css", "gallery.js"):
        asset = resources.files("imujoco_minari.pictures.gallery") / "site" / name
        write_text(folder / name, asset.read_text("utf-8"))
    # The index is written last, because it links to all other pages.
    write_text(folder / "index.html", index_page(entries))


def _read_state(folder: Path) -> dict[str, Any]:
    path = folder / STATE
    if not path.is_file():
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise StorageError(f"{folder} is not a gallery and not empty: choose a new folder")
        return {"format": FORMAT, "variants": {}}
    with suppress(OSError, ValueError, KeyError, TypeError):
        state = json.loads(path.read_text("utf-8"))
        if state["format"] == FORMAT and isinstance(state["variants"], dict):
            return dict(state)
    raise StorageError(
        f"{path} has another format than this version writes: remove it to draw the gallery again"
    )


def _site_variants(variants: Sequence[Variant], state: dict[str, Any]) -> set[Variant]:
    """Return ``variants``, their base robots and the variants that an earlier run has drawn."""
    drawn = (Variant.parse(name) for name, known in state["variants"].items() if known)
    return {*variants, *(variant.base for variant in variants), *drawn}


def _sort_by_catalogue(variants: set[Variant]) -> list[Variant]:
    """Return variants in the catalogue's order: each base before its variants, unlisted variants last."""
    listed = [v for robot in known_robots() for v in (Variant(robot), *catalogue(robot))]
    rank = {variant: number for number, variant in enumerate(listed)}
    return sorted(variants, key=lambda variant: (rank.get(variant, len(rank)), variant))
