"""The results page: findings, figures and tables, all but the findings computed from result lines."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

from imujoco_minari.benchmark import few_shot, offline, protocol, reproduction
from imujoco_minari.benchmark.figures import (
    ScoreFigure,
    across_figures,
    few_shot_figures,
    offline_figures,
    reproduction_figures,
)
from imujoco_minari.benchmark.lines import Line, is_of_earlier_experts, latest, read_lines
from imujoco_minari.benchmark.scores import (
    OTHERS_MARK,
    MethodScore,
    few_shot_scores,
    few_shot_values,
    offline_scores,
    offline_values,
)
from imujoco_minari.benchmark.submissions import check_submission
from imujoco_minari.benchmark.tables import (
    across_tables,
    few_shot_tables,
    folded,
    offline_tables,
    reproduction_table,
)
from imujoco_minari.errors import BenchmarkError, clipped

_HOW = """A score is a normalised return: 0 is the random policy's and 1 the expert's of the same variant. It
is an interquartile mean over variants and seeds. Its 95 % bootstrap interval in parentheses is over seeds:
read it to compare methods on these variants. The one in brackets is over variants and seeds: read it to judge
how a method would score in other variants of the same kind."""
_STATED = "[The benchmark](benchmark.md) defines every setting and says how to submit yours."
_EARLIER = """The results of these sections are of earlier experts than those that this version ships: {}.
They are being computed again. Until then, a score of 1 in them is the return of the earlier expert."""
_MADE = """`imujoco benchmark page` makes this page from the result lines, and `results.csv` beside it has
every score."""
_OTHERS = (
    "† a method of others. `docs/results/others` has its lines, which `imujoco benchmark check` accepts."
)
_REPRODUCED = """The relative error of the actions on the held-out variants of HalfCheetah, by gradient
steps: the mean of the seeds ± their standard deviation."""
# What tells the lines of a file apart. The files are in the order of Results.
CELLS = {
    few_shot.FILE: few_shot.CELL,
    offline.FILE: offline.CELL,
    offline.ACROSS_FILE: offline.CELL,
    reproduction.FILE: reproduction.CELL,
}
# What shows that a line can be scored.
_VALUES: dict[str, Callable[[Line], object]] = {
    few_shot.FILE: few_shot_values,
    offline.FILE: offline_values,
    offline.ACROSS_FILE: offline_values,
    reproduction.FILE: lambda line: reproduction.comparison([line]),
}
# What each line has, and what of it names figures and stands on the page.
_ENTRIES = ("protocol", "method", "settings", "seed", "versions", "results", "data_sha256")
_DECIDED = {
    few_shot.FILE: (protocol.NAME, "train_sha256", "policies_sha256"),
    offline.FILE: (offline.NAME, "variants", "policies_sha256"),
    offline.ACROSS_FILE: (offline.ACROSS, "variants", "policies_sha256"),
    reproduction.FILE: (reproduction.NAME, "train_sha256"),
}
_NAMES = ("method", "split", "tier", "train_tier", "robot", "budget")
_NAME = re.compile(r"[\w%+.:,=() -]{1,100}")


@dataclass(frozen=True)
class Results:
    """The lines of each file of a results folder, the last of each cell.

    The methods of others are named by their folders, with a mark.
    """

    few_shot: Sequence[Line]
    offline: Sequence[Line]
    across: Sequence[Line]
    reproduction: Sequence[Line]
    others: Sequence[Line] = ()

    def all(self) -> list[Line]:
        """Return all lines but those of others."""
        return [*self.few_shot, *self.offline, *self.across, *self.reproduction]

    @cached_property
    def scores(self) -> tuple[list[MethodScore], ...]:
        """The scores of few-shot, of offline and of across lines, with those of others."""
        few = [line for line in self.others if line["protocol"] == protocol.NAME]
        off = [line for line in self.others if line["protocol"] == offline.NAME]
        return (
            few_shot_scores([*self.few_shot, *few]),
            offline_scores([*self.offline, *off]),
            offline_scores(self.across),
        )


@dataclass(frozen=True)
class Section:
    """A section of the page. Its tables are Markdown."""

    title: str
    # What its results answer.
    question: str
    # How its first figure is read.
    reading: str
    lines: Sequence[Line]
    figures: Sequence[ScoreFigure]
    tables: str


def sections(results: Results) -> list[Section]:
    """Return the sections that have lines."""
    few, off, across = results.scores
    errors = folded("Errors of the actions", f"{_REPRODUCED}\n\n{reproduction_table(results.reproduction)}")
    found = [
        Section(
            "Few-shot imitation",
            "How well does a method act in another variant after a few demonstrations?",
            "Higher is better, 1 is the expert; more demonstrations are on the right.",
            results.few_shot,
            few_shot_figures(few),
            few_shot_tables(few),
        ),
        Section(
            "Offline learning",
            "How well does an algorithm act that learns from a dataset of the base robot?",
            "Higher is better, 1 is the expert; each group of bars is a kind of data.",
            results.offline,
            offline_figures(off),
            offline_tables(off),
        ),
        Section(
            "Learning across variants",
            "How well does an algorithm that learns from many variants act in others?",
            "Higher is better, 1 is the expert; each group of bars is a category of held-out variants.",
            results.across,
            across_figures(across),
            across_tables(across),
        ),
        Section(
            "The published comparison",
            "Does MAML or fine-tuning predict the actions of another variant better?",
            "Lower is better; more gradient steps are on the right, and the published errors are grey.",
            results.reproduction,
            reproduction_figures(results.reproduction),
            errors,
        ),
    ]
    return [section for section in found if section.lines]


def read_results(folder: Path) -> Results:
    """Return the lines of a folder, and those of others in its folders ``others/<name>``.

    Raises:
        BenchmarkError: if the folder has none, a line is not a result, or lines of others have a fault.
    """
    own = Results(
        *(latest(read_lines(folder / name, partial(_check, name)), cell) for name, cell in CELLS.items())
    )
    found = replace(own, others=list(_others(folder / "others")))
    if not found.all():
        raise BenchmarkError(f"{folder} has no results: `imujoco benchmark few-shot` computes some")
    return found


def _check(name: str, line: Line) -> None:
    """Check that a line of a file can be scored, and that its names are safe in file names and in Markdown.

    Raises:
        KeyError: if it lacks an entry.
        ValueError: if one is not valid.
    """
    wanted, *decided = _DECIDED[name]
    for key in (*_ENTRIES, *decided, *(key for key in CELLS[name] if key != "train_tier")):
        line[key]
    if line["protocol"] != wanted:
        raise ValueError(f"its protocol is not {wanted}")
    for key in _NAMES:
        if key in line and not (isinstance(line[key], str) and _NAME.fullmatch(line[key])):
            raise ValueError(
                f"{key} is {clipped(ascii(line[key]))}; valid: letters, digits, spaces and _%+.:,=()-"
            )
    if type(line["seed"]) is not int:
        raise ValueError("its seed is not a whole number")
    dict(line["versions"])
    _VALUES[name](line)


def _others(folder: Path) -> Iterator[Line]:
    for own in sorted(path for path in folder.glob("*") if path.is_dir()):
        if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", own.name):
            raise BenchmarkError(f"{own}: a folder's name has only small letters, digits and single hyphens")
        if faults := check_submission(own):
            raise BenchmarkError(f"{own}: {faults[0]}; `imujoco benchmark check {own}` lists all faults")
        for each in (few_shot, offline):
            yield from ({**line, "method": own.name + OTHERS_MARK} for line in read_lines(own / each.FILE))


def results_page(results: Results, parts: Sequence[Section], findings: str = "") -> str:
    """Return the results page as Markdown: figures, findings, and folded tables and details.

    The findings are Markdown. The text before their first heading follows the figures, and each of their
    sections is folded at the end of the page.
    """
    head, *details = re.split(r"^## ", findings.strip(), flags=re.MULTILINE)
    first, tables = [], []
    for part in parts:
        # The amount of data is what a user chooses; a small run has no such figure.
        data = (figure for figure in part.figures if figure.name.endswith("-data"))
        if lead := next(data, next(iter(part.figures), None)):
            first += [f"**{part.question}**", _drawn(lead), part.reading]
        tables += [f"## {part.title}", part.tables]
        if more := [_drawn(figure) for figure in part.figures if figure != lead]:
            tables.append(folded("More figures", "\n\n".join(more)))
        tables.append(_note(part.lines))
    if details:
        tables.append("## Findings in detail")
    for each in details:
        title, _, text = each.partition("\n")
        tables.append(folded(title.strip(), text))
    marked = _OTHERS if results.others else ""
    earlier = [part.title for part in parts if any(map(is_of_earlier_experts, part.lines))]
    stated = [_STATED, _EARLIER.format(", ".join(earlier)) if earlier else ""]
    texts = ["# Results", *stated, *first, head, _HOW, marked, *tables, _MADE]
    return "\n\n".join(text.strip() for text in texts if text) + "\n"


def _drawn(figure: ScoreFigure) -> str:
    return f"![{figure.title}](results-figures/{figure.name}.svg)"


def _note(lines: Sequence[Line]) -> str:
    """Return sentences with the numbers of lines and of seeds, and the versions."""
    versions = sorted({f"{name} {number}" for line in lines for name, number in line["versions"].items()})
    seeds = len({line["seed"] for line in lines})
    return f"Cells: {len(lines)}. Seeds: {seeds}. Computed with {', '.join(versions)}."
