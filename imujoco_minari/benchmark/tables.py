"""Markdown tables of scores."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby, product
from operator import attrgetter, itemgetter

from imujoco_minari.benchmark import reproduction
from imujoco_minari.benchmark.lines import Line
from imujoco_minari.benchmark.methods import COMPARISONS
from imujoco_minari.benchmark.offline import ACROSS_ALGORITHMS, ALGORITHMS, ALL_TIERS, SHIFTED_TIER
from imujoco_minari.benchmark.scores import (
    ALL,
    SHIFTED,
    TYPICAL_BUDGET,
    MethodScore,
    budgets_of,
    few_shot_scores,
    in_order,
)
from imujoco_minari.variants import BASE, CATEGORIES, ROBOTS

# Caption, columns and rows.
Table = tuple[str, list[str], list[list[str]]]


def few_shot_tables(scores: Sequence[MethodScore]) -> str:
    """Return Markdown tables of few-shot scores, folded by split: by budget, and by category."""
    parts = []
    whole = [score for score in scores if score.category == ALL]
    for group, tier in dict.fromkeys((score.group, score.tier) for score in whole):
        own = [score for score in scores if (score.group, score.tier) == (group, tier)]
        columns, rows = _by_budget([score for score in own if score.category == ALL])
        typical = [s for s in own if s.budget == TYPICAL_BUDGET or s.method in COMPARISONS]
        by = {(s.method, str(s.steps), s.category): s for s in typical}
        for category in CATEGORIES:
            if any(score.category == category for score in typical):
                columns.append(f"{category}, {TYPICAL_BUDGET}")
                for row in rows:
                    row.append(_cell(by.get((row[0], row[1], category))))
        count = max(score.variants for score in own)
        parts.append(folded(f"{group}, {tier}, {count} held-out variants", table(columns, rows)))
    return "\n\n".join(parts)


def variant_tables(lines: Sequence[Line]) -> dict[str, list[Table]]:
    """Return the tables of each held-out variant of few-shot lines: one for each split and tier."""
    found: dict[str, list[Table]] = {}
    key = itemgetter("variant", "split", "tier")
    for (variant, split, tier), own in groupby(sorted(lines, key=key), key):
        columns, rows = _by_budget([score for score in few_shot_scores(own) if score.category == ALL])
        found.setdefault(variant, []).append((f"{split}, {tier}", columns, rows))
    return found


def offline_tables(scores: Sequence[MethodScore]) -> str:
    """Return Markdown tables of offline scores, folded: on each base robot, and on other variants."""
    methods = in_order({score.method for score in scores}, ALGORITHMS)
    steps = sorted({score.steps for score in scores})
    last = {score.method: score.steps for score in sorted(scores, key=lambda score: score.steps)}
    found = {(s.group, s.tier, s.category, s.steps, s.method): s for s in scores}

    def cells(robot: str, tier: str, category: str, number: int | None = None) -> list[str]:
        keys = [(robot, tier, category, number or last[method], method) for method in methods]
        return [_cell(found.get(key)) for key in keys]

    parts = []
    for robot in ROBOTS:
        tiers = [tier for tier in ALL_TIERS if any((s.group, s.tier) == (robot, tier) for s in scores)]
        rows = [[t, f"{number:,}", *cells(robot, t, BASE, number)] for t in tiers for number in steps]
        if rows:
            text = table(["data", "updates", *methods], rows)
            parts.append(folded(f"{robot}, on the base robot", text))
    shifted = [(s.group, s.category) for s in scores if s.category != BASE]
    rows = [
        [robot, category, *cells(robot, SHIFTED_TIER, category)]
        for robot, category in product(ROBOTS, (SHIFTED, *CATEGORIES))
        if (robot, category) in shifted
    ]
    if rows:
        caption = f"From {SHIFTED_TIER} data of the base to other variants, after {steps[-1]:,} updates"
        caption += ", or as many as the method has" if len(set(last.values())) > 1 else ""
        parts.append(folded(caption, table(["robot", "variants", *methods], rows)))
    return "\n\n".join(parts)


def across_tables(scores: Sequence[MethodScore]) -> str:
    """Return Markdown tables of scores in held-out variants, folded by split."""
    methods = in_order({score.method for score in scores}, ACROSS_ALGORITHMS)
    parts = []
    for group in dict.fromkeys(score.group for score in scores):
        own = {(s.category, s.steps, s.method): s for s in scores if s.group == group}
        steps = sorted({key[1] for key in own})
        places = [(SHIFTED, number) for number in steps] + [(each, steps[-1]) for each in CATEGORIES]
        rows = [
            [category, f"{number:,}", *(_cell(own.get((category, number, method))) for method in methods)]
            for category, number in places
            if any(key[:2] == (category, number) for key in own)
        ]
        count = max(score.variants for score in own.values())
        text = table(["held-out variants", "updates", *methods], rows)
        parts.append(folded(f"{group}, {SHIFTED_TIER}, {count} held-out variants", text))
    return "\n\n".join(parts)


def reproduction_table(lines: Sequence[Line]) -> str:
    """Return a Markdown table of the errors of the published comparison, ours beside the published."""
    found = reproduction.comparison(lines)
    rows = []
    for (method, windows), group in groupby(found, attrgetter("method", "windows")):
        own = list(group)
        rows.append([method, str(windows), *(f"{row.error:.3f} ± {row.std:.3f}" for row in own)])
        if any(row.published for row in own):
            shown = ["" if row.published is None else f"{row.published:.3f}" for row in own]
            rows.append([f"{method}, published", str(windows), *shown])
    steps = dict.fromkeys(str(row.steps) for row in found)
    return table(["method", "windows", *steps], rows)


def folded(title: str, text: str) -> str:
    """Return Markdown that shows only its title until a reader opens it."""
    return f"<details>\n<summary>{title}</summary>\n\n{text.strip()}\n\n</details>"


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _by_budget(scores: Sequence[MethodScore]) -> tuple[list[str], list[list[str]]]:
    """Return the columns and rows of a table: methods and their steps by budget."""
    budgets = budgets_of(scores)
    rows = []
    for method in in_order({score.method for score in scores}):
        for steps in sorted({score.steps for score in scores if score.method == method}):
            found = {s.budget: s for s in scores if (s.method, s.steps) == (method, steps)}
            if method in COMPARISONS:
                found = dict.fromkeys(budgets, next(iter(found.values())))
            rows.append([method, str(steps), *(_cell(found.get(budget)) for budget in budgets)])
    return ["method", "steps", *budgets], rows


def _cell(score: MethodScore | None) -> str:
    if score is None:
        return ""
    middle, *ends = (_rounded(x) for x in (*score.interval, score.wide_low, score.wide_high))
    # One run or one variant has no interval.
    seeds = f" ({ends[0]} to {ends[1]})" if score.runs > 1 else ""
    variants = f" [{ends[2]} to {ends[3]}]" if score.runs > 1 and score.variants > 1 else ""
    return middle + seeds + variants


def _rounded(value: float) -> str:
    # Adding 0.0 turns -0.0 into 0.0.
    return f"{round(value, 2) + 0.0:.2f}"
