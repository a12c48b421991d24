"""The results page: findings, figures and tables, all but the findings computed from result lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from imujoco_minari.benchmark import few_shot, offline, reproduction
from imujoco_minari.benchmark.figures import (
    ScoreFigure,
    few_shot_figures,
    offline_figures,
    reproduction_figures,
)
from imujoco_minari.benchmark.lines import Line, latest, read_lines
from imujoco_minari.benchmark.scores import MethodScore, few_shot_scores, offline_scores
from imujoco_minari.benchmark.tables import few_shot_tables, offline_tables, reproduction_table
from imujoco_minari.errors import BenchmarkError

_HOW = """[The benchmark](benchmark.md) defines every setting. A score is a normalised return: 0 is the random
policy's and 1 the expert's of the same variant. It is an interquartile mean over variants and seeds, with its
95 % bootstrap interval over seeds. `imujoco benchmark page` makes this page from the result lines, and
`results.csv` beside it has every score."""
_REPRODUCED = """The relative error of the actions on the held-out variants of HalfCheetah, by gradient
steps: the mean of the seeds ± their standard deviation."""


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

    def scores(self) -> tuple[list[MethodScore], list[MethodScore]]:
        """Return the scores of the few-shot lines and those of the offline lines."""
        return few_shot_scores(self.few_shot), offline_scores(self.offline)


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
            parts += [f"## {title}", _note(lines), *_drawn(figures(own)), tables(own)]
    if results.reproduction:
        title, lines = "The published comparison", results.reproduction
        drawn = _drawn(reproduction_figures(lines))
        parts += [f"## {title}", _REPRODUCED, _note(lines), *drawn, reproduction_table(lines)]
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


def _drawn(figures: Sequence[ScoreFigure]) -> list[str]:
    return [f"![{figure.title}](results-figures/{figure.name}.svg)" for figure in figures]


def _note(lines: Sequence[Line]) -> str:
    """Return sentences with the numbers of lines and of seeds, and the versions."""
    versions = sorted({f"{name} {number}" for line in lines for name, number in line["versions"].items()})
    seeds = len({line["seed"] for line in lines})
    return f"Cells: {len(lines)}. Seeds: {seeds}. Computed with {', '.join(versions)}."
