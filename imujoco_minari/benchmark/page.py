"""The results page: findings, figures and tables, all but the findings computed from result lines."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from imujoco_minari.benchmark import few_shot, offline, protocol, reproduction
from imujoco_minari.benchmark.figures import (
    ScoreFigure,
    few_shot_figures,
    offline_figures,
    reproduction_figures,
)
from imujoco_minari.benchmark.lines import Line, latest, read_lines
from imujoco_minari.benchmark.scores import OTHERS_MARK, MethodScore, few_shot_scores, offline_scores
from imujoco_minari.benchmark.submissions import check_submission
from imujoco_minari.benchmark.tables import few_shot_tables, folded, offline_tables, reproduction_table
from imujoco_minari.errors import BenchmarkError, clipped

_HOW = """A score is a normalised return: 0 is the random policy's and 1 the expert's of the same variant. It
is an interquartile mean over variants and seeds, with its 95 % bootstrap interval over seeds."""
_STATED = """The results are of the experts that were published before the universal policies. [The
benchmark](benchmark.md) defines every setting and says how to submit yours."""
_MADE = """`imujoco benchmark page` makes this page from the result lines, and `results.csv` beside it has
every score."""
_OTHERS = (
    "† a method of others. `docs/results/others` has its lines, which `imujoco benchmark check` accepts."
)
_FEW_SHOT = (
    "Few-shot imitation",
    "How well does a method act in another variant after a few demonstrations?",
)
_OFFLINE = (
    "Offline learning",
    "How well does an algorithm act that learns from a dataset of the base robot?",
)
_PUBLISHED = (
    "The published comparison",
    "Does MAML or fine-tuning predict the actions of another variant better?",
)
_READ = {
    _FEW_SHOT[0]: "Higher is better, 1 is the expert; more demonstrations are on the right.",
    _OFFLINE[0]: "Higher is better, 1 is the expert; each group of bars is a kind of data.",
    _PUBLISHED[
        0
    ]: "Lower is better; more gradient steps are on the right, and the published errors are grey.",
}
_REPRODUCED = """The relative error of the actions on the held-out variants of HalfCheetah, by gradient
steps: the mean of the seeds ± their standard deviation."""
_OTHERS_FOLDER = "others"
_PROTOCOLS = (protocol.NAME, offline.NAME)
# What each line has, and what of it names figures and stands on the page.
_ENTRIES = ("protocol", "method", "settings", "seed", "versions", "results")
_NAMES = ("method", "split", "tier", "robot", "budget")
_NAME = re.compile(r"[\w%+.:,=() -]{1,100}")


@dataclass(frozen=True)
class Results:
    """The lines of a results folder, the last of each cell.

    Attributes:
        few_shot: lines of few-shot imitation.
        offline: lines of offline learning.
        reproduction: lines of the published comparison.
        others: lines of the methods of others, each named by its folder with a mark.
    """

    few_shot: Sequence[Line]
    offline: Sequence[Line]
    reproduction: Sequence[Line]
    others: Sequence[Line] = ()

    def all(self) -> list[Line]:
        """Return all lines but those of others."""
        return [*self.few_shot, *self.offline, *self.reproduction]

    def scores(self) -> tuple[list[MethodScore], list[MethodScore]]:
        """Return the scores of the few-shot lines and those of the offline lines, with those of others."""
        others = {name: [line for line in self.others if line["protocol"] == name] for name in _PROTOCOLS}
        return (
            few_shot_scores([*self.few_shot, *others[protocol.NAME]]),
            offline_scores([*self.offline, *others[offline.NAME]]),
        )


def read_results(folder: Path) -> Results:
    """Return the lines of a folder, and those of others in its folders ``others/<name>``.

    Raises:
        BenchmarkError: if the folder has none, a line is not a result, or lines of others have a fault.
    """
    few, off, reproduced = (
        latest(_named(folder / each.FILE, each.CELL), each.CELL) for each in (few_shot, offline, reproduction)
    )
    found = Results(few, off, reproduced, list(_others(folder / _OTHERS_FOLDER)))
    if not found.all():
        raise BenchmarkError(f"{folder} has no results: `imujoco benchmark few-shot` computes some")
    return found


def _named(file: Path, cell: tuple[str, ...]) -> Iterator[Line]:
    """Yield the lines of a file. Their names are safe in file names and in Markdown."""
    for number, line in enumerate(read_lines(file), start=1):
        for key in (*_ENTRIES, *cell):
            if key not in line:
                raise BenchmarkError(f"{file}, line {number}: not a result of the benchmark: it has no {key}")
        for key in _NAMES:
            if key in line and not (isinstance(line[key], str) and _NAME.fullmatch(line[key])):
                raise BenchmarkError(
                    f"{file}, line {number}: {key} is {clipped(ascii(line[key]))}; valid: letters, digits, "
                    "spaces and _ % + . : , = ( ) -"
                )
        yield line


def _others(folder: Path) -> Iterator[Line]:
    for own in sorted(path for path in folder.glob("*") if path.is_dir()):
        if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", own.name):
            raise BenchmarkError(f"{own}: a folder's name has only small letters, digits and single hyphens")
        if faults := check_submission(own):
            raise BenchmarkError(f"{own}: {faults[0]}; `imujoco benchmark check {own}` lists all faults")
        for each in (few_shot, offline):
            yield from ({**line, "method": own.name + OTHERS_MARK} for line in read_lines(own / each.FILE))


def results_page(
    results: Results, scores: tuple[Sequence[MethodScore], Sequence[MethodScore]], findings: str = ""
) -> str:
    """Return the results page as Markdown: figures, findings, and folded tables and details.

    Args:
        results: the lines.
        scores: those of the few-shot lines and those of the offline lines, with those of others.
        findings: Markdown. The text before its first heading follows the figures, and each of its sections is
            folded at the end of the page.
    """
    few_scores, off_scores = scores
    head, *details = re.split(r"^## ", findings.strip(), flags=re.MULTILINE)
    first, tables = [], []
    for (title, question), lines, figures, text in (
        (_FEW_SHOT, results.few_shot, few_shot_figures(few_scores), few_shot_tables(few_scores)),
        (_OFFLINE, results.offline, offline_figures(off_scores), offline_tables(off_scores)),
        (
            _PUBLISHED,
            results.reproduction,
            reproduction_figures(results.reproduction),
            folded("Errors of the actions", f"{_REPRODUCED}\n\n{reproduction_table(results.reproduction)}"),
        ),
    ):
        if not lines:
            continue
        # The amount of data is what a user chooses; a small run has no such figure.
        lead = next((figure for figure in figures if figure.name.endswith("-data")), figures[0])
        first += [f"**{question}**", _drawn(lead), _READ[title]]
        tables += [f"## {title}", text]
        if more := [_drawn(figure) for figure in figures if figure != lead]:
            tables.append(folded("More figures", "\n\n".join(more)))
        tables.append(_note(lines))
    if details:
        tables.append("## Findings in detail")
    for each in details:
        title, _, text = each.partition("\n")
        tables.append(folded(title.strip(), text))
    marked = _OTHERS if results.others else ""
    parts = ["# Results", _STATED, *first, head, _HOW, marked, *tables, _MADE]
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


def _drawn(figure: ScoreFigure) -> str:
    return f"![{figure.title}](results-figures/{figure.name}.svg)"


def _note(lines: Sequence[Line]) -> str:
    """Return sentences with the numbers of lines and of seeds, and the versions."""
    versions = sorted({f"{name} {number}" for line in lines for name, number in line["versions"].items()})
    seeds = len({line["seed"] for line in lines})
    return f"Cells: {len(lines)}. Seeds: {seeds}. Computed with {', '.join(versions)}."
