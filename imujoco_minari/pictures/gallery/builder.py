"""Makes the site: gathers, draws and writes variant by variant, and keeps what was done before.

The site's own ``gallery.json`` says which variants it has and what their pictures were drawn from.
It is written after each variant, so a run that is broken off goes on where it was.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from imujoco_minari.errors import ImujocoError, RenderingError, StorageError
from imujoco_minari.pictures.gallery.clips import ClipMaker
from imujoco_minari.pictures.gallery.entries import RANDOM, Clip, Entry, Score, changes, scores
from imujoco_minari.pictures.gallery.pages import index_page, variant_page
from imujoco_minari.pictures.rendering.files import check_format
from imujoco_minari.storage.files import write_text
from imujoco_minari.variants import Variant, bases, catalogue

STATE = "gallery.json"
FORMAT = 2
ASSETS = ("style.css", "gallery.js")


@dataclass(frozen=True)
class Built:
    """What a run made.

    Attributes:
        folder: the site's folder; ``index.html`` in it is the first page.
        variants: how many variants the site has, the bases among them.
        drawn: how many of them were drawn in this run.
        failed: variant -> why it is not in the site.
    """

    folder: Path
    variants: int
    drawn: int
    failed: dict[str, str]


def build(
    folder: Path, variants: Sequence[Variant], *, on_variant: Callable[[], None] | None = None
) -> Built:
    """Make the site in ``folder``, of ``variants``, of their base robots, and of what it has already.

    Args:
        folder: new, empty, or a site that an earlier run made.
        variants: which variants to add or bring up to date.
        on_variant: called after each variant.

    Raises:
        StorageError: when the folder is another's, or cannot be written.
        RenderingError: when there is no OpenGL to draw with.
        DependencyError: when what writes the clips is not installed.
    """
    check_format(Path("clip.mp4"))
    state = _read_state(folder)
    order = _in_order({*variants, *(variant.base for variant in variants), *_had(state)})
    entries, failed, drawn = [], {}, 0
    with ClipMaker(folder) as maker:
        for variant in order:
            known = state["variants"].setdefault(str(variant), {})
            try:
                clip, key, new = maker.draw(variant, known)
                entry = Entry(variant, changes(variant), scores(variant, _known_random(known)), clip)
            except (RenderingError, StorageError):
                # What stops one picture stops them all.
                raise
            except ImujocoError as error:
                failed[str(variant)] = str(error)
                del state["variants"][str(variant)]
            else:
                entries.append(entry)
                drawn += new
                _note(known, entry, clip, key)
                write_text(folder / STATE, json.dumps(state, indent=1) + "\n")
            if on_variant is not None:
                on_variant()
    _write_pages(folder, entries)
    return Built(folder, len(entries), drawn, failed)


def steps(folder: Path, variants: Sequence[Variant]) -> int:
    """Return how often :func:`build` will call ``on_variant``."""
    return len({*variants, *(variant.base for variant in variants), *_had(_read_state(folder))})


def _write_pages(folder: Path, entries: Sequence[Entry]) -> None:
    by_robot = {entry.variant.robot: entry for entry in entries if entry.variant == entry.variant.base}
    for number, entry in enumerate(entries):
        neighbours = (
            entries[number - 1].variant if number else None,
            entries[number + 1].variant if number + 1 < len(entries) else None,
        )
        text = variant_page(entry, by_robot.get(entry.variant.robot), neighbours)
        write_text(folder / "variants" / f"{entry.variant}.html", text)
    for name in ASSETS:
        write_text(
            folder / name,
            (resources.files("imujoco_minari.pictures.gallery") / "site" / name).read_text("utf-8"),
        )
    # Last, as it leads to all the others.
    write_text(folder / "index.html", index_page(entries))


def _read_state(folder: Path) -> dict[str, Any]:
    path = folder / STATE
    if not path.is_file():
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise StorageError(f"{folder} is no gallery and not empty: name a new folder")
        return {"format": FORMAT, "variants": {}}
    try:
        state = json.loads(path.read_text("utf-8"))
        if state["format"] == FORMAT and isinstance(state["variants"], dict):
            return dict(state)
    except (OSError, ValueError, KeyError, TypeError):
        pass
    raise StorageError(f"{path} is not what this version writes: remove it, and the gallery is drawn anew")


def _had(state: dict[str, Any]) -> set[Variant]:
    return {Variant.parse(name) for name, known in state["variants"].items() if known}


def _known_random(known: dict[str, Any]) -> Score | None:
    return Score(**known["random"]) if "random" in known else None


def _note(known: dict[str, Any], entry: Entry, clip: Clip, key: str) -> None:
    known.update(key=key, clip=asdict(clip))
    for score in entry.scores:
        if score.tier == RANDOM:
            known["random"] = asdict(score)


def _in_order(variants: set[Variant]) -> list[Variant]:
    """Return variants in the catalogue's order, each robot's base first, those outside it last."""
    listed = [v for base in bases() for v in (base, *catalogue(base.robot))]
    rank = {variant: number for number, variant in enumerate(listed)}
    return sorted(variants, key=lambda variant: (rank.get(variant, len(rank)), variant))
