"""The results page: Markdown tables and the data of its figures, all computed from result lines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, product
from operator import itemgetter
from pathlib import Path

from imujoco_minari.benchmark import few_shot, offline, protocol, reproduction
from imujoco_minari.benchmark.lines import Line, latest, read_lines
from imujoco_minari.benchmark.methods import COMPARISONS, METHODS
from imujoco_minari.benchmark.offline import ALGORITHMS, SHIFTED_TIER, TIERS
from imujoco_minari.benchmark.scores import ALL, OWN_EXPERT, SHIFTED, MethodScore, few_shot_scores
from imujoco_minari.errors import BenchmarkError
from imujoco_minari.variants import BASE, CATEGORIES, ROBOTS

# The setting of the table of parts, and of the figure of return against steps.
TYPICAL_BUDGET = "5x100"

_HOW = """[The benchmark](benchmark.md) defines every setting. A score is a normalised return: 0 is the random
policy's and 1 the expert's of the same variant. It is an interquartile mean over variants and seeds, with its
95 % bootstrap interval over seeds. `imujoco benchmark page` makes this page from the result lines, and
`results.csv` beside it has every number."""
_REPRODUCED = """The relative error of the actions on the held-out variants of HalfCheetah, by gradient
steps: the mean of the seeds ± their standard deviation."""
# A score and the ends of its interval.
_Interval = tuple[float, float, float]
# Caption, columns and rows.
Table = tuple[str, list[str], list[list[str]]]


@dataclass(frozen=True)
class Results:
    """The lines of a results folder, the last of each cell.

    Attributes:
        few_shot: lines of few-shot imitation.
        offline: lines of offline learning.
        reproduction: lines of the published comparison.
    """

    few_shot: Sequence[Line]
    offline: Sequence[Line]
    reproduction: Sequence[Line]

    def all(self) -> list[Line]:
        """Return all lines."""
        return [*self.few_shot, *self.offline, *self.reproduction]


@dataclass(frozen=True)
class ScoreFigure:
    """The data of a figure.

    Attributes:
        name: file name without ending.
        title: title of the figure.
        x_label: label of the x axis; empty for bars.
        ticks: labels on the x axis.
        panels: title of a panel -> method -> its score with its interval at each tick.
    """

    name: str
    title: str
    x_label: str
    ticks: tuple[str, ...]
    panels: Mapping[str, Mapping[str, Sequence[_Interval | None]]]


def read_results(folder: Path) -> Results:
    """Return the lines of a folder.

    Raises:
        BenchmarkError: if the folder has none, or a line is not a result.
    """
    found = Results(
        *(latest(read_lines(folder / each.FILE), each.CELL) for each in (few_shot, offline, reproduction))
    )
    if not found.all():
        raise BenchmarkError(f"{folder} has no results: `imujoco benchmark few-shot` computes some")
    return found


def few_shot_figures(scores: Sequence[MethodScore]) -> list[ScoreFigure]:
    """Return the figures of few-shot scores: return against data and against steps, by kind of split."""
    shown = _shown(scores)
    figures = []
    for kind in dict.fromkeys(_kind(score) for score in shown):
        chosen = [score for score in shown if _kind(score) == kind]
        budgets = _budgets(chosen)
        steps = sorted({score.steps for score in chosen})
        last = {score.method: score.steps for score in sorted(chosen, key=lambda score: score.steps)}
        data, descent = {}, {}
        for group in dict.fromkeys(score.group for score in chosen):
            of_group = [score for score in chosen if score.group == group]
            own = {(s.method, s.budget, s.steps): _interval(s) for s in of_group}
            title = f"{group}, {of_group[0].variants} variants"
            fixed = {m: next((i for k, i in own.items() if k[0] == m), None) for m in COMPARISONS}
            methods = [m for m in _ordered({key[0] for key in own}) if m not in COMPARISONS]
            grey = {f"comparison: {m}": fixed[m] for m in COMPARISONS if fixed[m] and m != "expert"}
            data[title] = {m: [own.get((m, b, last[m])) for b in budgets] for m in methods} | {
                name: [interval] * len(budgets) for name, interval in grey.items()
            }
            descent[title] = {m: [own.get((m, TYPICAL_BUDGET, s)) for s in steps] for m in methods} | {
                name: [interval] * len(steps) for name, interval in grey.items()
            }
        most, tier = max(steps), chosen[0].tier
        figures += [
            ScoreFigure(
                f"few-shot-{kind}-data",
                f"Return against data, after {most:,} steps, tier {tier}",
                "windows x steps demonstrated",
                tuple(budgets),
                data,
            ),
            ScoreFigure(
                f"few-shot-{kind}-steps",
                f"Return against steps, with {TYPICAL_BUDGET} demonstrated, tier {tier}",
                "gradient steps",
                tuple(map(str, steps)),
                descent,
            ),
        ]
    return figures


def offline_figures(scores: Sequence[MethodScore]) -> list[ScoreFigure]:
    """Return the figures of offline scores: by tier, by updates, and by category of shifted variants."""
    if not scores:
        return []
    found = {(s.group, s.tier, s.category, s.steps, s.method): _interval(s) for s in scores}
    robots, tiers, categories, steps, methods = (
        [value for value in order if any(key[place] == value for key in found)]
        for place, order in enumerate(
            (ROBOTS, TIERS, CATEGORIES, sorted({s.steps for s in scores}), ALGORITHMS)
        )
    )

    def figure(
        name: str, title: str, x_label: str, settings: Mapping[str, tuple[str, str, int]]
    ) -> ScoreFigure:
        panels = {
            r: {m: [found.get((r, *each, m)) for each in settings.values()] for m in methods} for r in robots
        }
        return ScoreFigure(name, f"Offline learning: {title}", x_label, tuple(settings), panels)

    last = steps[-1]
    figures = [figure("offline-base", "on the base robot", "", {tier: (tier, BASE, last) for tier in tiers})]
    figures += [
        figure(
            f"offline-{tier}-steps",
            f"return against updates, {tier}",
            "updates",
            {f"{n:,}": (tier, BASE, n) for n in steps},
        )
        for tier in tiers
    ]
    if categories:
        title = f"from {SHIFTED_TIER} data of the base to other variants"
        figures.append(
            figure("offline-shifted", title, "", {each: (SHIFTED_TIER, each, last) for each in categories})
        )
    return figures


def few_shot_tables(scores: Sequence[MethodScore]) -> str:
    """Return Markdown tables of few-shot scores: by budget, and over parts of the variants."""
    parts = []
    for group, tier in dict.fromkeys((score.group, score.tier) for score in scores):
        own = [score for score in scores if (score.group, score.tier) == (group, tier)]
        shown = _shown(own)
        count, whole = shown[0].variants, max(score.variants for score in own)
        which = " with an expert of their own" if shown[0].category == OWN_EXPERT else ""
        columns, rows = _by_budget(shown)
        parts.append(
            f"### {group}, {tier}\n\n{count} of {whole} held-out variants{which}:\n\n{table(columns, rows)}"
        )
        typical = [s for s in own if s.budget == TYPICAL_BUDGET or s.method in COMPARISONS]
        order = (ALL, OWN_EXPERT, *CATEGORIES)
        categories = [category for category in order if any(s.category == category for s in typical)]
        rows = []
        for method in _ordered({score.method for score in typical}):
            most = max(score.steps for score in typical if score.method == method)
            by = {s.category: s for s in typical if (s.method, s.steps) == (method, most)}
            rows.append([method, str(most), *(_cell(by.get(category)) for category in categories)])
        parts.append(
            f"All held-out variants and parts of them, with {TYPICAL_BUDGET} steps demonstrated:\n\n"
            + table(["method", "steps", *categories], rows)
        )
    return "\n".join(parts)


def variant_tables(lines: Sequence[Line]) -> dict[str, list[Table]]:
    """Return the tables of each held-out variant of few-shot lines: one for each split and tier."""
    found: dict[str, list[Table]] = {}
    key = itemgetter("variant", "split", "tier")
    for (variant, split, tier), own in groupby(sorted(lines, key=key), key):
        columns, rows = _by_budget([score for score in few_shot_scores(own) if score.category == ALL])
        found.setdefault(variant, []).append((f"{split}, {tier}", columns, rows))
    return found


def offline_tables(scores: Sequence[MethodScore]) -> str:
    """Return Markdown tables of offline scores: on the base robots, and on the variants."""
    methods = [method for method in ALGORITHMS if any(score.method == method for score in scores)]
    found = {(s.group, s.tier, s.category, s.steps, s.method): s for s in scores}
    settings, steps = {key[:-1] for key in found}, sorted({s.steps for s in scores})

    def rows(categories: Sequence[str], steps: Sequence[int], shown: Sequence[int]) -> list[list[str]]:
        return [
            [str(setting[place]) for place in shown] + [_cell(found.get((*setting, m))) for m in methods]
            for setting in product(ROBOTS, TIERS, categories, steps)
            if setting in settings
        ]

    text = "On the base robot:\n\n" + table(
        ["robot", "data", "updates", *methods], rows([BASE], steps, (0, 1, 3))
    )
    if shifted := rows([SHIFTED, *CATEGORIES], steps[-1:], (0, 2)):
        text += f"\nFrom {SHIFTED_TIER} data of the base to other variants, after {steps[-1]:,} updates:\n\n"
        text += table(["robot", "variants", *methods], shifted)
    return text


def reproduction_table(lines: Sequence[Line]) -> str:
    """Return a Markdown table of the errors of the published comparison, ours beside the published."""
    found = {(row.method, row.windows, row.steps): row for row in reproduction.comparison(lines)}
    steps = sorted({key[2] for key in found})
    rows = []
    for method, windows in dict.fromkeys(key[:2] for key in found):
        own = [found[method, windows, each] for each in steps]
        rows.append([method, str(windows), *(f"{row.error:.3f} ± {row.std:.3f}" for row in own)])
        published = [row.published for row in own]
        if any(published):
            shown = ["" if error is None else f"{error:.3f}" for error in published]
            rows.append([f"{method}, published", str(windows), *shown])
    return table(["method", "windows", *map(str, steps)], rows)


def results_page(
    results: Results, scores: tuple[Sequence[MethodScore], Sequence[MethodScore]], findings: str = ""
) -> str:
    """Return the results page as Markdown.

    Args:
        results: the lines.
        scores: those of the few-shot lines and those of the offline lines.
        findings: the text that begins the page, in Markdown.
    """
    few_scores, off_scores = scores
    parts = ["# Results", findings.strip(), _HOW]
    for title, lines, own, figures, tables in (
        ("Few-shot imitation", results.few_shot, few_scores, few_shot_figures, few_shot_tables),
        ("Offline learning", results.offline, off_scores, offline_figures, offline_tables),
    ):
        if lines:
            drawn = [f"![{each.title}](results-figures/{each.name}.svg)" for each in figures(own)]
            parts += [f"## {title}", _note(lines), *drawn, tables(own)]
    if results.reproduction:
        title, lines = "The published comparison", results.reproduction
        parts += [f"## {title}", _REPRODUCED, _note(lines), reproduction_table(lines)]
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


def _shown(scores: Sequence[MethodScore]) -> list[MethodScore]:
    """Return the scores over variants with their own expert, or over all variants of a split without any."""
    has_own = {(s.group, s.tier) for s in scores if s.category == OWN_EXPERT}
    return [s for s in scores if s.category == (OWN_EXPERT if (s.group, s.tier) in has_own else ALL)]


def _by_budget(scores: Sequence[MethodScore]) -> tuple[list[str], list[list[str]]]:
    """Return the columns and rows of a table: methods and their steps by budget."""
    budgets = _budgets(scores)
    rows = []
    for method in _ordered({score.method for score in scores}):
        for steps in sorted({score.steps for score in scores if score.method == method}):
            found = {s.budget: s for s in scores if (s.method, s.steps) == (method, steps)}
            if method in COMPARISONS:
                found = dict.fromkeys(budgets, next(iter(found.values())))
            rows.append([method, str(steps), *(_cell(found.get(budget)) for budget in budgets)])
    return ["method", "steps", *budgets], rows


def _budgets(scores: Sequence[MethodScore]) -> list[str]:
    """Return the budgets of the methods. The one budget of a comparison does not count."""
    found = {s.budget for s in scores if s.method not in COMPARISONS} or {s.budget for s in scores}
    return [str(budget) for budget in protocol.BUDGETS if str(budget) in found]


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _note(lines: Sequence[Line]) -> str:
    """Return sentences with the numbers of lines and of seeds, and the versions."""
    versions = sorted({f"{name} {number}" for line in lines for name, number in line["versions"].items()})
    seeds = len({line["seed"] for line in lines})
    return f"Cells: {len(lines)}. Seeds: {seeds}. Computed with {', '.join(versions)}."


def _kind(score: MethodScore) -> str:
    """Return the kind of a split and the tier, as ``extremes-v1-expert``."""
    return f"{score.group.partition('-')[2]}-{score.tier}"


def _ordered(methods: set[str]) -> list[str]:
    """Return methods in the order of this package's, then the others."""
    return [m for m in METHODS if m in methods] + sorted(methods - set(METHODS))


def _interval(score: MethodScore) -> _Interval:
    return score.iqm, score.low, score.high


def _cell(score: MethodScore | None) -> str:
    if score is None:
        return ""
    # Adding 0.0 turns -0.0 into 0.0.
    middle, low, high = (round(value, 2) + 0.0 for value in _interval(score))
    # One run has no interval.
    return f"{middle:.2f}" if score.runs == 1 else f"{middle:.2f} ({low:.2f} to {high:.2f})"
