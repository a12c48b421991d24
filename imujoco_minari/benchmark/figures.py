"""The data of the results page's figures: the scores of each method at the ticks of an axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter

from imujoco_minari.benchmark.lines import Line
from imujoco_minari.benchmark.methods import COMPARISONS
from imujoco_minari.benchmark.offline import ACROSS_ALGORITHMS, ALGORITHMS, ALL_TIERS, SHIFTED_TIER
from imujoco_minari.benchmark.reproduction import comparison
from imujoco_minari.benchmark.scores import (
    ALL,
    OTHERS_MARK,
    SHIFTED,
    TYPICAL_BUDGET,
    Interval,
    MethodScore,
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
    figures = _tier_figures(shown)
    for kind in dict.fromkeys(_kind(score) for score in shown):
        chosen = [score for score in shown if _kind(score) == kind]
        budgets = budgets_of(chosen)
        steps = sorted({score.steps for score in chosen})
        last = {score.method: score.steps for score in sorted(chosen, key=lambda score: score.steps)}
        data, descent = {}, {}
        for group in dict.fromkeys(score.group for score in chosen):
            of_group = [score for score in chosen if score.group == group]
            own = {(s.method, s.budget, s.steps): s.interval for s in of_group}
            title = f"{group}, {of_group[0].variants} variants"
            methods = [m for m in in_order({key[0] for key in own}) if m not in COMPARISONS]
            data[title] = {m: [own.get((m, b, last[m])) for b in budgets] for m in methods}
            descent[title] = {m: [own.get((m, TYPICAL_BUDGET, s)) for s in steps] for m in methods}
            for name in COMPARISONS:
                fixed: list[Interval | None] = [own[key] for key in own if key[0] == name]
                if fixed and name != "expert":
                    data[title][f"comparison: {name}"] = fixed[:1] * len(budgets)
                    descent[title][f"comparison: {name}"] = fixed[:1] * len(steps)
        stem, tier = f"few-shot-{kind}", f"tier {chosen[0].tier}"
        if len(budgets) > 1:
            title, label = f"Return against data, after {max(steps):,} steps", "windows x steps demonstrated"
            figures.append(ScoreFigure(f"{stem}-data", f"{title}, {tier}", label, tuple(budgets), data))
        title, ticks = f"Return against steps, with {TYPICAL_BUDGET} demonstrated", tuple(map(str, steps))
        figures.append(ScoreFigure(f"{stem}-steps", f"{title}, {tier}", "gradient steps", ticks, descent))
    return figures


def offline_figures(scores: Sequence[MethodScore]) -> list[ScoreFigure]:
    """Return the figures of offline scores: by tier, by updates, and by category of shifted variants."""
    if not scores:
        return []
    steps = sorted({score.steps for score in scores})
    tiers = [tier for tier in ALL_TIERS if any(score.tier == tier for score in scores)]
    by_tier = {tier: (tier, BASE, steps[-1]) for tier in tiers}
    figures = [_offline_figure("base", "on the base robot", "", by_tier, scores)]
    for tier in tiers:
        title = f"return against updates, tier {tier}"
        by_steps = {_short(number): (tier, BASE, number) for number in steps}
        figures.append(_offline_figure(f"{tier}-steps", title, "updates", by_steps, scores))
    present = {score.category for score in scores}
    by_category = {each: (SHIFTED_TIER, each, steps[-1]) for each in CATEGORIES if each in present}
    if by_category:
        title = f"from {SHIFTED_TIER} data of the base to other variants"
        figures.append(_offline_figure("shifted", title, "", by_category, scores))
    return figures


def across_figures(scores: Sequence[MethodScore]) -> list[ScoreFigure]:
    """Return the figures of scores in held-out variants: by category, and by updates."""
    if not scores:
        return []
    steps = sorted({score.steps for score in scores})
    present = {score.category for score in scores}
    by_category = {"all": (SHIFTED_TIER, SHIFTED, steps[-1])}
    by_category |= {each: (SHIFTED_TIER, each, steps[-1]) for each in CATEGORIES if each in present}
    by_steps = {_short(number): (SHIFTED_TIER, SHIFTED, number) for number in steps}
    title = "from many variants to others"
    return [
        _offline_figure("across", title, "", by_category, scores),
        _offline_figure("across-steps", title, "updates", by_steps, scores),
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


def _tier_figures(shown: Sequence[MethodScore]) -> list[ScoreFigure]:
    """Return the figure that compares tiers, if a split has scores of several tiers."""
    chosen = [s for s in shown if s.budget == TYPICAL_BUDGET and s.method not in COMPARISONS]
    tiers = tuple(dict.fromkeys(score.tier for score in chosen))
    last = {score.method: score.steps for score in sorted(chosen, key=lambda score: score.steps)}
    own = {(s.group, s.method, s.tier): s.interval for s in chosen if s.steps == last[s.method]}
    panels = {
        group: {method: [own.get((group, method, tier)) for tier in tiers] for method in in_order(set(last))}
        for group in dict.fromkeys(score.group for score in chosen)
        if len({score.tier for score in chosen if score.group == group}) > 1
    }
    title = f"Return by tier, with {TYPICAL_BUDGET} demonstrated"
    return [ScoreFigure("few-shot-tiers", title, "", tiers, panels)] if panels else []


def _offline_figure(
    name: str,
    title: str,
    x_label: str,
    settings: Mapping[str, tuple[str, str, int]],
    scores: Sequence[MethodScore],
) -> ScoreFigure:
    """Return a figure of offline scores with a panel for each group.

    ``settings`` maps the label of a tick to tier, category and number of updates.
    """
    panels: dict[str, dict[str, list[Interval | None]]] = {}
    for group in sorted({s.group for s in scores}, key=lambda name: ROBOTS.index(name.partition("-")[0])):
        own = {(s.method, s.tier, s.category, s.steps): s.interval for s in scores if s.group == group}
        for method in dict.fromkeys((*ALGORITHMS, *ACROSS_ALGORITHMS)):
            found = [own.get((method, *setting)) for setting in settings.values()]
            if any(found):
                panels.setdefault(group, {})[method] = found
    return ScoreFigure(f"offline-{name}", f"Offline learning: {title}", x_label, tuple(settings), panels)


def _kind(score: MethodScore) -> str:
    """Return the kind of a split and the tier, as ``extremes-v1-expert``."""
    return f"{score.group.partition('-')[2]}-{score.tier}"


def _short(number: int) -> str:
    """Return a number as a short text: thousands as ``25k``."""
    return str(number) if number % 1000 else f"{number // 1000}k"
