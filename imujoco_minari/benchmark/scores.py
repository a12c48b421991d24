"""Published numbers from result lines: interquartile means with bootstrap intervals.

As in rliable, a run is a seed and a task is a variant. The score of a run on a task is the mean normalised
return of its episodes: 0 is the random policy's return and 1 that of the variant's expert. Other than in
rliable, the bootstrap draws a seed for all variants at once, because one training serves all of them. A
second interval draws the variants too.
"""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from operator import attrgetter
from typing import Any

import numpy as np

from imujoco_minari.benchmark import offline, protocol
from imujoco_minari.benchmark.lines import Line
from imujoco_minari.benchmark.methods import COMPARISONS, METHODS
from imujoco_minari.policies.aggregates import bootstrap_interval, interquartile_mean
from imujoco_minari.short_repr import short_repr
from imujoco_minari.variants import BASE, CATEGORIES, EXPERT, ROBOTS, Variant

ALL = "all"
# The variants that offline data do not contain.
SHIFTED = "shifted"
# The setting of the scores by category, and of the figure of return against steps.
TYPICAL_BUDGET = "5x100"
# Follows the names of the methods of others.
OTHERS_MARK = " †"
# Values of a score's fields in the order in which they are shown. Those of users follow.
_ORDER = [*METHODS, *offline.ALGORITHMS, *offline.ACROSS_ALGORITHMS, *map(str, protocol.BUDGETS)]
_ORDER += [EXPERT, *offline.ALL_TIERS, *ROBOTS, BASE, SHIFTED, *CATEGORIES]
_ORDER += [f"{robot}-{kind}-v1" for robot in ROBOTS for kind in ("extremes", "random")]
# A score and the ends of its interval.
Interval = tuple[float, float, float]


@dataclass(frozen=True)
class MethodScore:
    """The score of one method in one setting.

    Attributes:
        group: the split, or the robot of an offline dataset of its base.
        tier: the tier of the data.
        method: name of the method.
        budget: how much was demonstrated; empty for offline data.
        steps: gradient steps.
        category: the category of the variants; ``all`` for all of them. In offline learning ``base`` for the
            base robot, and ``shifted`` for the variants that the data do not contain.
        iqm: interquartile mean of the scores.
        low: lower end of the 95 % interval.
        high: upper end of the 95 % interval.
        wide_low: lower end of the 95 % interval over variants and seeds.
        wide_high: upper end of the 95 % interval over variants and seeds.
        error: median relative error of the actions; NaN for offline data.
        variants: number of variants.
        runs: number of seeds that all variants have.
    """

    group: str
    tier: str
    method: str
    budget: str
    steps: int
    category: str
    iqm: float
    low: float
    high: float
    wide_low: float
    wide_high: float
    error: float
    variants: int
    runs: int

    __repr__ = short_repr

    @property
    def interval(self) -> Interval:
        """The score and the ends of its interval."""
        return self.iqm, self.low, self.high


# The first fields of a score.
_Key = tuple[str, str, str, str, int, str]
# Values by variant and seed.
_Values = dict[str, dict[int, float]]


def few_shot_scores(lines: Iterable[Line]) -> list[MethodScore]:
    """Return the scores of few-shot lines: over all variants of a split, and over each category."""
    returns: dict[_Key, _Values] = defaultdict(lambda: defaultdict(dict))
    errors: dict[_Key, list[float]] = defaultdict(list)
    for line in lines:
        variant, tier = line["variant"], line["tier"]
        if "train_tier" in line:
            tier += f" (trained on {line['train_tier']})"
        for steps, score, error in few_shot_values(line):
            for each in (ALL, Variant.parse(variant).category):
                key = (line["split"], tier, line["method"], line["budget"], steps, each)
                returns[key][variant][line["seed"]] = score
                errors[key].append(error)
    scores = [_score(key, values, float(np.median(errors[key]))) for key, values in returns.items()]
    return list(filter(None, scores))


def offline_scores(lines: Iterable[Line]) -> list[MethodScore]:
    """Return the scores of offline lines: on the base of a robot, on the variants, and on each category.

    The group of a line is its robot, or the split whose training variants it has learnt from.
    """
    returns: dict[_Key, _Values] = defaultdict(lambda: defaultdict(dict))
    for line in lines:
        across = line["protocol"] == offline.ACROSS
        group = offline.ACROSS_SPLIT.format(line["robot"]) if across else line["robot"]
        for variant, updates, score in offline_values(line):
            category = Variant.parse(variant).category
            for each in (BASE,) if category == BASE else (SHIFTED, category):
                key = (group, line["tier"], line["method"], "", updates, each)
                returns[key][variant][line["seed"]] = score
    return list(filter(None, (_score(key, values, float("nan")) for key, values in returns.items())))


def few_shot_values(line: Line) -> list[tuple[int, float, float]]:
    """Return the gradient steps of a few-shot line, and after each the score and the error of the actions."""
    return [
        (int(steps), normalised_mean(result["returns"], line["references"]), float(result["error"]))
        for steps, result in line["results"].items()
    ]


def offline_values(line: Line) -> list[tuple[str, int, float]]:
    """Return the score of an offline line in each variant after each number of updates."""
    return [
        (variant, int(updates), normalised_mean(result["returns"], line["references"][variant]))
        for variant, by_updates in line["results"].items()
        for updates, result in by_updates.items()
    ]


def budgets_of(scores: Sequence[MethodScore]) -> list[str]:
    """Return the budgets of the methods. The one budget of a comparison does not count."""
    return in_order({s.budget for s in scores if s.method not in COMPARISONS} or {s.budget for s in scores})


def after_most_steps(scores: Sequence[MethodScore]) -> list[MethodScore]:
    """Return the scores after the largest number of steps of each method."""
    last = {score.method: score.steps for score in sorted(scores, key=attrgetter("steps"))}
    return [score for score in scores if score.steps == last[score.method]]


def in_order(values: set[Any]) -> list[Any]:
    """Return values of one field of scores in the order in which they are shown: numbers rise."""
    known = dict.fromkeys(value for value in _ORDER if value in values)
    return [*known, *sorted(values - known.keys())]


def normalised_mean(returns: Sequence[float], references: Sequence[float]) -> float:
    """Return the mean of returns on the scale where the references are 0 and 1.

    Raises:
        ValueError: if there are no returns, a number is not finite, or the references are equal.
    """
    low, high = references
    if not returns or not np.isfinite([low, high, *returns]).all():
        raise ValueError("its returns and references are not finite numbers")
    if low == high:
        raise ValueError(f"both of its references are {low}, so it cannot be scored; run its cell again")
    return (float(np.mean(returns)) - low) / (high - low)


def to_csv(scores: Iterable[MethodScore]) -> str:
    """Return scores as CSV text with a header."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(MethodScore)], lineterminator="\n")
    writer.writeheader()
    for score in scores:
        values = asdict(score).items()
        writer.writerow({name: round(x, 4) if isinstance(x, float) else x for name, x in values})
    return text.getvalue()


def _score(key: _Key, values: _Values, error: float) -> MethodScore | None:
    """Return the score of the seeds that all variants have; None if there is none."""
    seeds = sorted(set.intersection(*map(set, values.values())))
    if not seeds:
        return None
    matrix = np.array([[scores[seed] for scores in values.values()] for seed in seeds])
    return MethodScore(
        *key,
        interquartile_mean(matrix),
        *bootstrap_interval(matrix),
        *bootstrap_interval(matrix, tasks=True),
        error,
        len(values),
        len(seeds),
    )
