"""Markdown tables of scores."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, groupby, product
from operator import attrgetter, itemgetter

from imujoco_minari.benchmark import reproduction
from imujoco_minari.benchmark.lines import Line
from imujoco_minari.benchmark.methods import COMPARISONS
from imujoco_minari.benchmark.offline import SHIFTED_TIER
from imujoco_minari.benchmark.scores import (
    ALL,
    SHIFTED,
    TYPICAL_BUDGET,
    MethodScore,
    after_most_steps,
    budgets_of,
    few_shot_scores,
    in_order,
)
from imujoco_minari.variants import BASE, CATEGORIES

# Caption, columns and rows.
Table = tuple[str, list[str], list[list[str]]]

_METHODS = {"method": "method", "steps": "steps"}


def few_shot_tables(scores: Sequence[MethodScore]) -> str:
    """Return Markdown tables of few-shot scores, folded by split: by budget, and by category."""
    parts = []
    for group, tier in product(in_order({s.group for s in scores}), in_order({s.tier for s in scores})):
        own = [score for score in scores if (score.group, score.tier) == (group, tier)]
        if not any(score.category == ALL for score in own):
            continue
        columns = _by_budget(own)
        typical = [s for s in own if s.budget == TYPICAL_BUDGET or s.method in COMPARISONS]
        for category in CATEGORIES:
            if of_category := [score for score in typical if score.category == category]:
                columns[f"{category}, {TYPICAL_BUDGET}"] = of_category
        caption = f"{group}, {tier}, {_held_out(own)}"
        parts.append(folded(caption, table(*_table(_METHODS, columns))))
    return "\n\n".join(parts)


def variant_tables(lines: Sequence[Line]) -> dict[str, list[Table]]:
    """Return the tables of each held-out variant of few-shot lines: one for each split and tier."""
    found: dict[str, list[Table]] = {}
    key = itemgetter("variant", "split", "tier")
    for (variant, split, tier), own in groupby(sorted(lines, key=key), key):
        columns = _by_budget(few_shot_scores(own))
        found.setdefault(variant, []).append((f"{split}, {tier}", *_table(_METHODS, columns)))
    return found


def offline_tables(scores: Sequence[MethodScore]) -> str:
    """Return Markdown tables of offline scores, folded: on each base robot, and on other variants."""
    parts = []
    base = [score for score in scores if score.category == BASE]
    for robot in in_order({score.group for score in base}):
        own = [score for score in base if score.group == robot]
        fields = {"data": "tier", "updates": "steps"}
        parts.append(_by_method(f"{robot}, on the base robot", fields, own))
    shifted = [score for score in after_most_steps(scores) if score.category != BASE]
    if shifted:
        steps = sorted({score.steps for score in after_most_steps(scores)})
        caption = f"From {SHIFTED_TIER} data of the base to other variants, after {steps[-1]:,} updates"
        caption += ", or as many as the method has" if len(steps) > 1 else ""
        parts.append(_by_method(caption, {"robot": "group", "variants": "category"}, shifted))
    return "\n\n".join(parts)


def across_tables(scores: Sequence[MethodScore]) -> str:
    """Return Markdown tables of scores in held-out variants, folded by split."""
    parts = []
    for group in in_order({score.group for score in scores}):
        own = [score for score in scores if score.group == group]
        caption = f"{group}, {SHIFTED_TIER}, {_held_out(own)}"
        shown = [score for score in own if score.category == SHIFTED]
        shown += [score for score in after_most_steps(own) if score.category != SHIFTED]
        fields = {"held-out variants": "category", "updates": "steps"}
        parts.append(_by_method(caption, fields, shown))
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


def _held_out(scores: Sequence[MethodScore]) -> str:
    """Return the number of held-out variants in words."""
    count = max(score.variants for score in scores)
    return f"{count} held-out variant{'s' if count > 1 else ''}"


def _by_budget(scores: Sequence[MethodScore]) -> dict[str, list[MethodScore]]:
    """Return the scores in all variants by budget. The policies of comparisons serve each budget."""
    whole = [score for score in scores if score.category == ALL]
    return {
        budget: [score for score in whole if score.budget == budget or score.method in COMPARISONS]
        for budget in budgets_of(whole)
    }


def _by_method(caption: str, fields: Mapping[str, str], scores: Sequence[MethodScore]) -> str:
    """Return a folded table with a column for each method."""
    methods = in_order({score.method for score in scores})
    columns = {method: [score for score in scores if score.method == method] for method in methods}
    return folded(caption, table(*_table(fields, columns)))


def _table(
    fields: Mapping[str, str], columns: Mapping[str, Sequence[MethodScore]]
) -> tuple[list[str], list[list[str]]]:
    """Return the columns and rows of a table of scores, whose columns are given by name.

    The values of some fields name a row. They are in the first columns.
    """
    row_of, scores = attrgetter(*fields.values()), list(chain(*columns.values()))
    found = {name: {row_of(score): _cell(score) for score in own} for name, own in columns.items()}
    values = [in_order({getattr(score, field) for score in scores}) for field in fields.values()]
    present = set(map(row_of, scores))
    rows = [
        [*map(_text, row), *(cells.get(row, "") for cells in found.values())]
        for row in product(*values)
        if row in present
    ]
    return [*fields, *found], rows


def _text(value: str | int) -> str:
    return f"{value:,}" if isinstance(value, int) and value >= 10_000 else str(value)


def _cell(score: MethodScore) -> str:
    middle, *ends = (_rounded(x) for x in (*score.interval, score.wide_low, score.wide_high))
    # One run or one variant has no interval.
    seeds = f" ({ends[0]} to {ends[1]})" if score.runs > 1 else ""
    variants = f" [{ends[2]} to {ends[3]}]" if score.runs > 1 and score.variants > 1 else ""
    return middle + seeds + variants


def _rounded(value: float) -> str:
    # Adding 0.0 turns -0.0 into 0.0.
    return f"{round(value, 2) + 0.0:.2f}"
