"""Published numbers from result lines: interquartile means with stratified bootstrap intervals.

As in rliable, a run is a seed and a task is a variant. The score of a run on a task is the mean normalised
return of its episodes: 0 is the random policy's return and 1 that of the variant's expert.
"""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields

import numpy as np

from imujoco_minari.benchmark.lines import Line
from imujoco_minari.policies.aggregates import bootstrap_interval, interquartile_mean
from imujoco_minari.variants import Variant

ALL = "all"


@dataclass(frozen=True)
class MethodScore:
    """The score of one method in one setting.

    Attributes:
        group: the split, or robot and tier of an offline dataset.
        tier: the tier of the data.
        method: name of the method.
        budget: how much was demonstrated; empty for offline data.
        steps: gradient steps.
        category: the category of the variants; ``all`` for all of them.
        iqm: interquartile mean of the scores.
        low: lower end of the 95 % interval.
        high: upper end of the 95 % interval.
        error: median relative error of the actions; NaN for offline data.
        variants: number of variants.
        runs: number of seeds of the variant with the fewest.
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
    error: float
    variants: int
    runs: int


# The first fields of a score.
_Key = tuple[str, str, str, str, int, str]
# Values by variant, one for each seed.
_Values = dict[str, list[float]]


def few_shot_scores(lines: Iterable[Line]) -> list[MethodScore]:
    """Return the scores of few-shot lines, over all variants of a split and over those of a category."""
    returns: dict[_Key, _Values] = defaultdict(lambda: defaultdict(list))
    errors: dict[_Key, list[float]] = defaultdict(list)
    for line in lines:
        category = Variant.parse(line["variant"]).category
        for steps, result in line["results"].items():
            for each in (ALL, category):
                key = (line["split"], line["tier"], line["method"], line["budget"], int(steps), each)
                score = normalised_mean(result["returns"], line["references"])
                returns[key][line["variant"]].append(score)
                errors[key].append(result["error"])
    return [_score(key, values, float(np.median(errors[key]))) for key, values in returns.items()]


def offline_scores(lines: Iterable[Line]) -> list[MethodScore]:
    """Return the scores of offline lines: on the base of a robot, and on the variants together."""
    returns: dict[_Key, _Values] = defaultdict(lambda: defaultdict(list))
    for line in lines:
        for variant, result in line["results"].items():
            where = "base" if variant == f"{line['robot']}-base" else "shifted"
            key = (line["robot"], line["tier"], line["method"], "", line["updates"], where)
            returns[key][variant].append(normalised_mean(result["returns"], line["references"][variant]))
    return [_score(key, values, float("nan")) for key, values in returns.items()]


def normalised_mean(returns: Sequence[float], references: Sequence[float]) -> float:
    """Return the mean of returns on the scale where the references are 0 and 1."""
    low, high = references
    return (float(np.mean(returns)) - low) / (high - low)


def to_csv(scores: Iterable[MethodScore]) -> str:
    """Return scores as CSV text with a header."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(MethodScore)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {
            name: round(value, 4) if isinstance(value, float) else value
            for name, value in asdict(score).items()
        }
        for score in scores
    )
    return text.getvalue()


def _score(key: _Key, values: Mapping[str, list[float]], error: float) -> MethodScore:
    runs = min(map(len, values.values()))
    # Runs by variants. A seed that some variants lack is left out.
    matrix = np.array([scores[:runs] for scores in values.values()]).T
    low, high = bootstrap_interval(matrix)
    return MethodScore(*key, interquartile_mean(matrix), low, high, error, len(values), runs)
