"""The style of all figures, with colours for colour-blind people too, and their PNG and SVG files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from imujoco_minari.errors import missing_dependency
from imujoco_minari.storage.files import whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's colours without black, and without yellow, which is hard to see on white.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
# Lines differ in their dashes too, so colour is never the only difference.
DASHES = ("-", "--", ":", "-.")
BASE_FILL, BASE_EDGE = "#c3c9d0", "#69727c"

_SETTINGS: Any = {
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.0,
    "figure.titlesize": 11.0,
    "legend.frameon": False,
    "savefig.dpi": 160,
    # The same data give the same file.
    "svg.hashsalt": "imujoco",
    "svg.fonttype": "none",
}


@contextmanager
def new_figure(width: float, height: float, title: str) -> Iterator[Figure]:
    """Yield an empty figure of a width and a height in inches, with a title.

    What is drawn in the context has the style of all figures.

    Raises:
        DependencyError: if matplotlib is not installed.
    """
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
    except ImportError:
        raise missing_dependency("matplotlib", "plot", "drawing plots") from None
    with rc_context(_SETTINGS):
        figure = Figure(figsize=(width, height), layout="constrained")
        figure.suptitle(title, x=0.01, ha="left")
        yield figure


def save(figure: Figure, stem: Path) -> list[Path]:
    """Write a figure to ``stem.png`` and ``stem.svg`` and return both paths."""
    from matplotlib import rc_context

    paths = [stem.with_name(stem.name + ending) for ending in (".png", ".svg")]
    for path in paths:
        with rc_context(_SETTINGS), whole_file(path) as partial:
            figure.savefig(partial, metadata={"Date": None} if path.suffix == ".svg" else {"Software": None})
    return paths


def line_style(number: int) -> dict[str, Any]:
    """Return the colour and the dashes of line ``number``, counted from 0."""
    return {"color": COLOURS[number % len(COLOURS)], "linestyle": DASHES[number % len(DASHES)]}
