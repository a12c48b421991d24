"""The transfer matrix as a heat map: one row per policy, one column per variant, grouped by category."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from imujoco_minari.errors import VariantError
from imujoco_minari.pictures.plotting.style import new_figure, save
from imujoco_minari.policies.transfer import Transfer
from imujoco_minari.variants import Variant

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Up to this number of rows and columns the cells show numbers. In larger figures they are not readable.
NUMBERED = 12
# Size in inches of a cell, and of the space for labels and colour bar at the side and below.
CELL, SIDE, BELOW = 0.24, 3.4, 3.0


def plot_transfer(transfer: Transfer, stem: Path) -> list[Path]:
    """Draw a transfer into ``stem.png`` and ``stem.svg`` and return both paths.

    Raises:
        DependencyError: if matplotlib is not installed.
        StorageError: if a file cannot be written.
    """
    return save(draw_transfer(transfer), stem)


def draw_transfer(transfer: Transfer) -> Figure:
    """Draw the mean returns of policies on variants."""
    returns = np.array(transfer.returns())
    numbered = max(returns.shape) <= NUMBERED
    cell = 2 * CELL if numbered else CELL
    width, height = SIDE + cell * returns.shape[1], BELOW + cell * returns.shape[0]
    title = f"How do the policies of {transfer.variants[0].robot} score on other variants?"
    with new_figure(width, height, title) as figure:
        axes = figure.subplots()
        # Viridis is readable for colour-blind people and in grey.
        image = axes.imshow(returns, cmap="viridis", aspect="auto", interpolation="nearest")
        bar = figure.colorbar(image, ax=axes, pad=0.01, fraction=0.05, aspect=30)
        bar.set_label("mean undiscounted return (reward)")
        columns = [_column_label(variant) for variant in transfer.variants]
        axes.set_xticks(range(len(columns)), columns, rotation=90)
        axes.set_yticks(range(len(transfer.policies)), [_row_label(name) for name in transfer.policies])
        axes.set_xlabel("evaluated on the variant; circle: the policy's own")
        axes.set_ylabel("policy")
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        _separate_categories(axes, transfer)
        _mark_own_variants(axes, transfer)
        if numbered:
            _write_numbers(axes, returns)
    return figure


def _separate_categories(axes: Axes, transfer: Transfer) -> None:
    """Separate the categories by lines and write their names above the columns."""
    start = 0
    for category, members in groupby(transfer.variants, key=lambda variant: variant.category):
        end = start + len(list(members))
        if start:
            axes.axvline(start - 0.5, color="white", linewidth=2.5)
        axes.text((start + end - 1) / 2, -0.7, category, ha="center", va="bottom")
        start = end
    rows = [_category(policy) for policy in transfer.policies]
    for row in range(1, len(rows)):
        if rows[row] != rows[row - 1]:
            axes.axhline(row - 0.5, color="white", linewidth=2.5)


def _mark_own_variants(axes: Axes, transfer: Transfer) -> None:
    """Mark the cell of each expert on its own variant."""
    names = list(map(str, transfer.variants))
    own = [(names.index(policy), row) for row, policy in enumerate(transfer.policies) if policy in names]
    if own:
        x, y = zip(*own, strict=True)
        axes.plot(x, y, "o", color="white", markeredgecolor="black", markersize=3.5, markeredgewidth=0.6)


def _write_numbers(axes: Axes, returns: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> None:
    middle = (returns.min() + returns.max()) / 2
    for (row, column), value in np.ndenumerate(returns):
        ink = "black" if value > middle else "white"
        axes.text(column, row + 0.32, f"{value:.0f}", ha="center", va="center", color=ink, fontsize=6.5)


def _column_label(variant: Variant) -> str:
    return " and ".join(f"{change.body} {change.percent:+g} %" for change in variant.changes) or "base"


def _row_label(name: str) -> str:
    """Return the label of a policy's row. The robot is in the title, so it is removed from a variant."""
    return name.partition("-")[2] if _category(name) else name


def _category(name: str) -> str:
    """Return the category of the variant that a policy is named after, or an empty string."""
    try:
        return Variant.parse(name).category
    except VariantError:
        return ""
