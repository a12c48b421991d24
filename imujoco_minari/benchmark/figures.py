"""The data of the results page's figures: the scores of each method at the ticks of an axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import attrgetter
from typing import Any

from imujoco_minari.benchmark.lines import Line
from imujoco_minari.benchmark.methods import COMPARISONS
from imujoco_minari.benchmark.offline import SHIFTED_TIER
from imujoco_minari.benchmark.reproduction import comparison
from imujoco_minari.benchmark.scores import (
    ALL,
    OTHERS_MARK,
    SHIFTED,
    TYPICAL_BUDGET,
    Interval,
    MethodScore,
    after_most_steps,
    budgets_of,
    in_order,
)
from imujoco_minari.variants import BASE, CATEGORIES, ROBOTS


@dataclass(frozen=True)
class ScoreFigure:
    """The data of a figure.

    Attributes:
        name: file name without ending.
        title: title of the figure.
        x_label: label of the x axis; empty for bars.
        ticks: labels on the x axis.
        panels: title of a panel -> method -> its score with its interval at each tick.
        y_label: label of the y axis.
        reference: height of a thin grey line; None for no line.
    """

    name: str
    title: str
    x_label: str
    ticks: tuple[str, ...]
    panels: Mapping[str, Mapping[str, Sequence[Interval | None]]]
    y_label: str = "normalised return (interquartile mean)"
    # The score of the variant's expert.
    reference: float | None = 1.0


def few_shot_figures(scores: Sequence[MethodScore]) -> list[ScoreFigure]:
    """Return the figures of few-shot scores: return by tier, against data, and against steps.

    The methods of others are not in them, nor demonstrations that cover only some variants of a split.
    """
    whole = [score for score in scores if score.category == ALL and not score.method.endswith(OTHERS_MARK)]
    counts = {(score.group, score.tier): score.variants for score in whole}
    shown = [
        score
        for score in whole
        if counts[score.group, score.tier] == max(n for key, n in counts.items() if key[0] == score.group)
    ]
    own = after_most_steps([s for s in shown if s.budget == TYPICAL_BUDGET and s.method not in COMPARISONS])
    tiers = {group: {score.tier for score in own if score.group == group} for group, _ in counts}
    title = f"Return by tier, with {TYPICAL_BUDGET} demonstrated"
    figures = _figure("few-shot-tiers", title, "", "tier", [s for s in own if len(tiers[s.group]) > 1])
    for kind in dict.fromkeys(map(_kind, shown)):
        chosen = [score for score in shown if _kind(score) == kind]
        titles = {score.group: f"{score.group}, {score.variants} variants" for score in reversed(chosen)}
        chosen = [replace(score, group=titles[score.group]) for score in chosen]
        stem, tier = f"few-shot-{kind}", f"tier {chosen[0].tier}"
        if len(budgets_of(chosen)) > 1:
            title = f"Return against data, after {max(score.steps for score in chosen):,} steps, {tier}"
            label = "windows x steps demonstrated"
            figures += _figure(f"{stem}-data", title, label, "budget", after_most_steps(chosen))
        title = f"Return against steps, with {TYPICAL_BUDGET} demonstrated, {tier}"
        typical = [s for s in chosen if s.budget == TYPICAL_BUDGET or s.method in COMPARISONS]
        figures += _figure(f"{stem}-steps", title, "gradient steps", "steps", typical)
    return figures


def offline_figures(scores: Sequence[MethodScore]) -> list[ScoreFigure]:
    """Return the figures of offline scores: by tier, by updates, and by category of shifted variants.

    The methods of others are not in them.
    """
    own = sorted((s for s in scores if not s.method.endswith(OTHERS_MARK)), key=_robot)
    base = [score for score in own if score.category == BASE]
    last, title = after_most_steps(own), "Offline learning: on the base robot"
    figures = _figure("offline-base", title, "", "tier", [score for score in last if score.category == BASE])
    for tier in in_order({score.tier for score in base}):
        title = f"Offline learning: return against updates, tier {tier}"
        of_tier = [score for score in base if score.tier == tier]
        figures += _figure(f"offline-{tier}-steps", title, "updates", "steps", of_tier)
    title = f"Offline learning: from {SHIFTED_TIER} data of the base to other variants"
    shifted = [score for score in last if score.category in CATEGORIES]
    return figures + _figure("offline-shifted", title, "", "category", shifted)


def across_figures(scores: Sequence[MethodScore]) -> list[ScoreFigure]:
    """Return the figures of scores in held-out variants: by category, and by updates."""
    title, own = "Offline learning: from many variants to others", sorted(scores, key=_robot)
    shifted = [score for score in own if score.category == SHIFTED]
    return [
        *_figure("offline-across", title, "", "category", after_most_steps(own)),
        *_figure("offline-across-steps", title, "updates", "steps", shifted),
    ]


def reproduction_figures(lines: Sequence[Line]) -> list[ScoreFigure]:
    """Return the figure of the published comparison: error against steps, by number of windows."""
    rows = comparison(lines)
    if not rows:
        return []
    panels: dict[str, dict[str, list[Interval | None]]] = {}
    for (method, windows), group in groupby(rows, attrgetter("method", "windows")):
        own = list(group)
        panel = panels.setdefault(f"windows: {windows}", {})
        panel[method] = [(row.error, row.error - row.std, row.error + row.std) for row in own]
        if any(row.published for row in own):
            panel[f"comparison: {method}, published"] = [
                None if row.published is None else (row.published,) * 3 for row in own
            ]
    ticks = tuple(dict.fromkeys(str(row.steps) for row in rows))
    title = "The published comparison on HalfCheetah: mean of the seeds and standard deviation"
    label = "relative error of the actions"
    return [ScoreFigure("reproduction", title, "gradient steps", ticks, panels, label, None)]


def _figure(
    name: str, title: str, x_label: str, field: str, scores: Sequence[MethodScore]
) -> list[ScoreFigure]:
    """Return a figure of scores with a panel for each group, and a field of a score on its x axis.

    There is none without scores.
    """
    methods = [score for score in scores if score.method not in COMPARISONS] or scores
    ticks = in_order({getattr(score, field) for score in methods})
    panels: dict[str, dict[str, list[Interval | None]]] = {}
    for group in dict.fromkeys(score.group for score in scores):
        panel = panels.setdefault(group, {})
        of_group = [score for score in scores if score.group == group]
        for method in in_order({score.method for score in of_group}):
            own: dict[Any, Interval | None] = {
                getattr(score, field): score.interval for score in of_group if score.method == method
            }
            if method not in COMPARISONS:
                panel[method] = [own.get(tick) for tick in ticks]
            elif method != "expert":
                panel[f"comparison: {method}"] = [*own.values()][:1] * len(ticks)
    return [ScoreFigure(name, title, x_label, tuple(map(_label, ticks)), panels)] if panels else []


def _kind(score: MethodScore) -> str:
    """Return the kind of a split and the tier, as ``extremes-v1-expert``."""
    return f"{score.group.partition('-')[2]}-{score.tier}"


def _robot(score: MethodScore) -> int:
    """Return the place of a score's robot among all."""
    return ROBOTS.index(score.group.partition("-")[0])


def _label(value: str | int) -> str:
    """Return the label of a tick: ``25k`` for 25,000, and ``all`` for all held-out variants."""
    if isinstance(value, int):
        return str(value) if value % 1000 or value < 10_000 else f"{value // 1000}k"
    return ALL if value == SHIFTED else value
