"""Figures that compare datasets with the base robot's: returns, episode lengths, actions, observations.

Each figure answers one question. It shows the base robot's dataset of the same tier in grey.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from imujoco_minari.envs.mjcf import variant_model
from imujoco_minari.envs.registration import dataset_name
from imujoco_minari.errors import DatasetError, check_one_robot
from imujoco_minari.loading import Arrays, arrays
from imujoco_minari.pictures.plotting.style import BASE_EDGE, BASE_FILL, line_style, new_figure, save
from imujoco_minari.policies import Array
from imujoco_minari.storage import minari_root
from imujoco_minari.variants import BASE, Variant, specification

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BINS = 60
# The bins cover the values between these percentiles. The few extremes of a fall would flatten the rest.
PERCENTILES = (0.1, 99.9)
COLUMNS = 4

_TURNS = tuple(f"quaternion {part} of {{}} (1)" for part in "wxyz")
_SPINS = tuple(f"velocity about {axis} of {{}} (rad/s)" for axis in "xyz")
# The labels of a joint's positions and velocities.
_JOINT_LABELS: dict[mujoco.mjtJoint, tuple[tuple[str, ...], tuple[str, ...]]] = {
    mujoco.mjtJoint.mjJNT_HINGE: (("angle of {} (rad)",), ("velocity of {} (rad/s)",)),
    mujoco.mjtJoint.mjJNT_SLIDE: (("position of {} (m)",), ("velocity of {} (m/s)",)),
    mujoco.mjtJoint.mjJNT_BALL: (_TURNS, _SPINS),
    mujoco.mjtJoint.mjJNT_FREE: (
        (*(f"{axis} of {{}} (m)" for axis in "xyz"), *_TURNS),
        (*(f"velocity along {axis} of {{}} (m/s)" for axis in "xyz"), *_SPINS),
    ),
}


@dataclass(frozen=True, eq=False)
class Series:
    """One dataset to draw, of one robot."""

    dataset_id: str
    data: Arrays

    @property
    def robot(self) -> str:
        """The name of the robot."""
        return self.data.table[0].robot

    @property
    def tiers(self) -> list[str]:
        """The tiers of the episodes."""
        return sorted({origin.tier for origin in self.data.table})

    @property
    def is_base(self) -> bool:
        """Whether all episodes are of the unchanged robot."""
        return all(origin.category == BASE for origin in self.data.table)


def load_series(dataset_id: str) -> Series:
    """Load a dataset for drawing.

    Raises:
        DatasetNotFoundError: if the root has no such dataset.
        DatasetError: if its episodes are not all of one robot of this package, or hold NaN or infinity.
    """
    data = arrays(dataset_id, dtype=np.float32)
    if not data.table[0].robot:
        raise DatasetError(f"{dataset_id} cannot be drawn: it does not state its robot")
    for name in ("observations", "actions", "rewards"):
        if not np.isfinite(getattr(data, name)).all():
            raise DatasetError(f"{dataset_id} cannot be drawn: its {name} hold NaN or infinity")
    return Series(dataset_id, data)


def with_bases(series: Sequence[Series]) -> tuple[list[Series], list[str]]:
    """Return the series of base robots before the given ones, and the ids of missing base datasets."""
    wanted = dict.fromkeys(
        Variant(one.robot).dataset_id(tier) for one in series if not one.is_base for tier in one.tiers
    )
    names = {dataset_name(one.dataset_id) for one in series}
    bases = [base for base in wanted if dataset_name(base) not in names]
    present = [base for base in bases if minari_root.exists(base)]
    ordered = sorted([*map(load_series, present), *series], key=lambda one: not one.is_base)
    return ordered, [base for base in bases if base not in present]


def labels(series: Sequence[Series]) -> list[str]:
    """Return the names of datasets, or the whole ids of those that have the same name."""
    names = [dataset_name(one.dataset_id) for one in series]
    labelled = zip(names, series, strict=True)
    return [name if names.count(name) == 1 else one.dataset_id for name, one in labelled]


def plot_datasets(
    series: Sequence[Series], folder: Path, on_figure: Callable[[], None] | None = None
) -> list[Path]:
    """Draw every figure of datasets of one robot into ``folder`` and return the files.

    Raises:
        DatasetError: if the datasets are of several robots.
        DependencyError: if matplotlib is not installed.
        StorageError: if a file cannot be written.
    """
    check_one_robot(((one.robot, one.dataset_id) for one in series), "a plot is of")
    files = []
    for name, draw in FIGURES.items():
        files += save(draw(series), folder / name)
        if on_figure is not None:
            on_figure()
    return files


def observation_labels(robot: str) -> list[str]:
    """Return the labels of the positions, then of the velocities, with which an observation begins."""
    model, page = variant_model(Variant(robot)), specification(robot)
    positions, velocities = [], []
    for joint in map(model.joint, range(model.njnt)):
        of_position, of_velocity = _JOINT_LABELS[mujoco.mjtJoint(joint.type[0])]
        positions += [label.format(joint.name) for label in of_position]
        velocities += [label.format(joint.name) for label in of_velocity]
    # The positions that are left out, as the travelled distance, are the first.
    return positions[-page.observed_positions :] + velocities


def action_labels(robot: str) -> list[str]:
    """Return the labels of an action: torques as shares of the motor's gear."""
    model = variant_model(Variant(robot))
    joints = [model.joint(number).name for number, _ in model.actuator_trnid]
    gears = [gear for gear, *_ in model.actuator_gear]
    return [f"action on {name} (1 = {gear:g} N m)" for name, gear in zip(joints, gears, strict=True)]


def _line_styles(series: Sequence[Series]) -> list[dict[str, Any]]:
    """Return the style of each series; the base robots' are grey and have none of the numbered styles."""
    numbers = count()
    return [{"color": BASE_EDGE} if one.is_base else line_style(next(numbers)) for one in series]


def _draw_rows(attribute: str, title: str, unit: str, series: Sequence[Series]) -> Figure:
    """Draw one row per dataset, with a dot per episode, their median and their quartiles."""
    with new_figure(8.0, 1.3 + 0.36 * len(series), title) as figure:
        axes = figure.subplots()
        rng = np.random.default_rng(0)
        for row, (one, style) in enumerate(zip(series, _line_styles(series), strict=True)):
            numbers, colour = getattr(one.data, attribute), style["color"]
            height = row + rng.uniform(-0.22, 0.22, len(numbers))
            axes.plot(numbers, height, ".", color=colour, alpha=0.45, markersize=4, markeredgewidth=0)
            low, middle, high = np.percentile(numbers, (25, 50, 75))
            axes.plot((low, high), (row, row), color=colour, linewidth=5, solid_capstyle="butt", alpha=0.7)
            axes.plot(middle, row, "o", color="white", markeredgecolor="black", markersize=6)
        rows = zip(labels(series), series, strict=True)
        axes.set_yticks(range(len(series)), [f"{label}  (n = {one.data.episodes})" for label, one in rows])
        axes.set_ylim(len(series) - 0.5, -0.5)
        # Beside long names the axes are narrower than this label.
        axes.set_xlabel(f"{unit}; circle: median, bar: quartiles", loc="right")
        axes.grid(axis="x", color="#e3e7eb", linewidth=0.8)
        axes.set_axisbelow(True)
    return figure


def _draw_distributions(
    attribute: str, column_labels: Callable[[str], list[str]], title: str, series: Sequence[Series]
) -> Figure:
    """Draw one panel per column, with one line per dataset over the base robot's grey area."""
    columns = column_labels(series[0].robot)
    across = min(COLUMNS, len(columns))
    down = -(-len(columns) // across)
    legend = 0.25 * -(-len(series) // 2)
    with new_figure(2.6 * across, 0.8 + 1.75 * down + legend, title) as figure:
        panels = figure.subplots(down, across, squeeze=False).flat
        for place, label in enumerate(columns):
            steps = [getattr(one.data, attribute)[:, place] for one in series]
            _draw_distribution(panels[place], series, steps)
            panels[place].set_xlabel(label)
            panels[place].set_ylabel("share of steps (%)" if place % across == 0 else "")
        for empty in panels[len(columns) :]:
            empty.set_visible(False)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower left", ncols=2)
    return figure


def _draw_distribution(axes: Axes, series: Sequence[Series], values: Sequence[Array]) -> None:
    bounds = np.array([np.percentile(numbers, PERCENTILES) for numbers in values])
    low, high = float(bounds[:, 0].min()), float(bounds[:, 1].max())
    if low == high:
        low, high = low - 0.5, high + 0.5
    edges = np.linspace(low, high, BINS + 1)
    drawn = zip(series, labels(series), values, _line_styles(series), strict=True)
    for one, label, numbers, style in drawn:
        # Values outside the bins count in the first or last bin, so no step is hidden.
        counts, _ = np.histogram(np.clip(numbers.astype(np.float64), low, high), edges)
        share = 100.0 * counts / len(numbers)
        if one.is_base:
            axes.stairs(share, edges, fill=True, color=BASE_FILL, label=label)
        else:
            axes.stairs(share, edges, label=label, linewidth=1.2, **style)
    axes.set_xlim(low, high)


# The name of each figure's files, and the function that draws it.
FIGURES: dict[str, Callable[[Sequence[Series]], Figure]] = {
    "returns": partial(
        _draw_rows, "returns", "What do the episodes score?", "undiscounted return of an episode (reward)"
    ),
    "lengths": partial(
        _draw_rows, "episode_lengths", "How long are the episodes?", "length of an episode (steps)"
    ),
    "actions": partial(_draw_distributions, "actions", action_labels, "How do the policies act?"),
    "observations": partial(
        _draw_distributions, "observations", observation_labels, "Which states do the robots visit?"
    ),
}
