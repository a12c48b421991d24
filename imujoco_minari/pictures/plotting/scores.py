"""Scores of several methods: curves with bands of uncertainty, and bars with whiskers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from imujoco_minari.pictures.plotting.style import (
    BASE_EDGE,
    BASE_FILL,
    line_style,
    new_figure,
    save,
    settings,
)

# Score, lower and upper end of its interval; None where there is none.
Interval: TypeAlias = "tuple[float, float, float] | None"
# Title of a panel -> label of a method -> its interval at each tick.
Panels: TypeAlias = Mapping[str, Mapping[str, Sequence[Interval]]]

# Size in inches of a panel, and of the legend at the side.
WIDTH, HEIGHT, SIDE = 2.9, 2.9, 1.7


def plot_curves(panels: Panels, ticks: Sequence[str], labels: tuple[str, str, str], stem: Path) -> list[Path]:
    """Draw a curve for each method over the ticks, in a panel for each title; write PNG and SVG.

    Args:
        panels: the intervals; a method whose label begins with ``bound`` is drawn in grey.
        ticks: labels of the places on the x axis.
        labels: title of the figure, label of the x axis and of the y axis.
        stem: the files' path without ending.

    Returns:
        The files.

    Raises:
        DependencyError: if matplotlib is not installed.
        StorageError: if a file cannot be written.
    """
    title, x_label, y_label = labels
    figure = new_figure(SIDE + WIDTH * max(len(panels), 1.4), HEIGHT, title)
    methods = _methods(panels)
    coloured = [method for method in methods if not method.startswith("bound")]
    bounds = [method for method in methods if method.startswith("bound")]
    with settings():
        row = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (name, curves) in zip(row, panels.items(), strict=True):
            for method, intervals in curves.items():
                style = (
                    {**line_style(coloured.index(method)), "marker": "o", "markersize": 3.5}
                    if method in coloured
                    else {"color": BASE_EDGE, "linestyle": line_style(1 + bounds.index(method))["linestyle"]}
                )
                found = [(x, *interval) for x, interval in enumerate(intervals) if interval is not None]
                x, middle, low, high = np.array(found, float).reshape(-1, 4).T
                axes.plot(x, middle, label=method, **style)
                axes.fill_between(x, low, high, color=style["color"], alpha=0.18, linewidth=0)
            axes.axhline(1.0, color=BASE_FILL, linewidth=0.8, zorder=0)
            axes.set_title(name, loc="left")
            axes.set_xticks(range(len(ticks)), list(ticks))
            axes.set_xlabel(x_label)
        row[0].set_ylabel(y_label)
        handles = {
            label: line for axes in row for line, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(
            [handles[method] for method in methods], methods, loc="outside right center", handlelength=3.0
        )
    return save(figure, stem)


def plot_bars(panels: Panels, ticks: Sequence[str], labels: tuple[str, str], stem: Path) -> list[Path]:
    """Draw a bar with a whisker for each method at each tick, in a panel for each title; write PNG and SVG.

    Args:
        panels: the intervals.
        ticks: labels of the groups of bars.
        labels: title of the figure and label of the y axis.
        stem: the files' path without ending.

    Returns:
        The files.

    Raises:
        DependencyError: if matplotlib is not installed.
        StorageError: if a file cannot be written.
    """
    title, y_label = labels
    figure = new_figure(SIDE + WIDTH * max(len(panels), 1.4), HEIGHT, title)
    methods = _methods(panels)
    width = 0.8 / len(methods)
    with settings():
        row = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (name, bars) in zip(row, panels.items(), strict=True):
            for method, intervals in bars.items():
                place = methods.index(method)
                found = [(x, *interval) for x, interval in enumerate(intervals) if interval is not None]
                x, middle, low, high = np.array(found, float).reshape(-1, 4).T
                x += (place - (len(methods) - 1) / 2) * width
                axes.bar(x, middle, 0.9 * width, color=line_style(place)["color"], label=method)
                whiskers = np.maximum([middle - low, high - middle], 0.0)
                axes.errorbar(x, middle, whiskers, fmt="none", ecolor="black", elinewidth=0.8)
            axes.axhline(1.0, color=BASE_FILL, linewidth=0.8, zorder=0)
            axes.set_title(name, loc="left")
            axes.set_xticks(range(len(ticks)), [tick.replace("-", "-\n", 1) for tick in ticks])
        row[0].set_ylabel(y_label)
        handles, found_labels = row[0].get_legend_handles_labels()
        figure.legend(handles, found_labels, loc="outside right center")
    return save(figure, stem)


def _methods(panels: Panels) -> list[str]:
    return list(dict.fromkeys(method for curves in panels.values() for method in curves))
