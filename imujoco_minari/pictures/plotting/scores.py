"""Scores of several methods: curves with bands of uncertainty, or bars with whiskers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from imujoco_minari.pictures.plotting.style import BASE_EDGE, BASE_FILL, line_style, new_figure, save
from imujoco_minari.policies import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Score, lower and upper end of its interval; None where there is none.
Interval: TypeAlias = "tuple[float, float, float] | None"
# Title of a panel -> label of a method -> its interval at each tick.
Panels: TypeAlias = Mapping[str, Mapping[str, Sequence[Interval]]]

# Size in inches of a panel, and of the legend at the side.
WIDTH, HEIGHT, SIDE = 2.9, 2.9, 1.7
_COMPARISON = "comparison"


def plot_scores(
    panels: Panels,
    ticks: Sequence[str],
    labels: tuple[str, str, str],
    stem: Path,
    reference: float | None = 1.0,
) -> list[Path]:
    """Draw the scores of each method at the ticks, a panel for each title, into a PNG and an SVG file.

    They are curves with bands if the x axis has a label, or else bars with whiskers.

    Args:
        panels: the intervals; a curve whose label begins with ``comparison`` is grey.
        ticks: labels of the places on the x axis.
        labels: title of the figure, label of the x axis and of the y axis.
        stem: the files' path without ending.
        reference: height of a thin grey line; None for no line.
    """
    title, x_label, y_label = labels
    draw = _draw_curve if x_label else _draw_bars
    names = list(ticks) if x_label else [tick.replace("-", "-\n", 1) for tick in ticks]
    methods = list(dict.fromkeys(method for scores in panels.values() for method in scores))
    with new_figure(SIDE + WIDTH * max(len(panels), 1.4), HEIGHT, title) as figure:
        row = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (name, scores) in zip(row, panels.items(), strict=True):
            for method, intervals in scores.items():
                found = [(x, *interval) for x, interval in enumerate(intervals) if interval is not None]
                draw(axes, method, methods, np.array(found, float).reshape(-1, 4).T)
            if reference is not None:
                axes.axhline(reference, color=BASE_FILL, linewidth=0.8, zorder=0)
            axes.set_title(name, loc="left")
            axes.set_xticks(range(len(ticks)), names)
            axes.set_xlabel(x_label)
        row[0].set_ylabel(y_label)
        entries = [zip(*axes.get_legend_handles_labels(), strict=True) for axes in row]
        handles = {label: line for own in entries for line, label in own}
        lines = [handles[method] for method in methods]
        figure.legend(lines, methods, loc="outside right center", handlelength=3.0)
    return save(figure, stem)


def _draw_curve(axes: Axes, method: str, methods: Sequence[str], points: Array) -> None:
    # Comparisons are numbered apart from the methods. They are grey lines with dashes.
    grey = method.startswith(_COMPARISON)
    place = [other for other in methods if other.startswith(_COMPARISON) == grey].index(method)
    style = line_style(place + 1) | {"color": BASE_EDGE} if grey else line_style(place)
    x, middle, low, high = points
    axes.plot(x, middle, label=method, marker="" if grey else "o", markersize=3.5, **style)
    axes.fill_between(x, low, high, color=style["color"], alpha=0.18, linewidth=0)
    if len(x) == 1:
        # A band over one point is not visible.
        axes.vlines(x, low, high, color=style["color"], linewidth=1.2)


def _draw_bars(axes: Axes, method: str, methods: Sequence[str], points: Array) -> None:
    place, width = methods.index(method), 0.8 / len(methods)
    x, middle, low, high = points
    x = x + (place - (len(methods) - 1) / 2) * width
    axes.bar(x, middle, 0.9 * width, color=line_style(place)["color"], label=method)
    whiskers = np.maximum([middle - low, high - middle], 0.0)
    axes.errorbar(x, middle, whiskers, fmt="none", ecolor="black", elinewidth=0.8)
