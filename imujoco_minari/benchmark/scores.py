"""Published numbers from result lines: interquartile means with stratified bootstrap intervals.

As in rliable, a run is a seed and a task is a variant. The score of a run on a task is the mean normalised
return of its episodes: 0 is the random policy's return and 1 that of the variant's expert.
"""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.benchmark.lines import Line
from imujoco_minari.variants import Variant

ALL = "all"
REPETITIONS = 2000


@dataclass(frozen=True)
class Score:
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


def few_shot_scores(lines: Iterable[Line]) -> list[Score]:
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


def offline_scores(lines: Iterable[Line]) -> list[Score]:
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


def interquartile_mean(values: Any) -> Any:
    """Return the mean of the middle half of the values along the last axis.

    A quarter of the values, rounded down, is left out at either end.

    Example:
        >>> float(interquartile_mean([0.0, 1.0, 2.0, 30.0]))
        1.5
    """
    ordered = np.sort(np.asarray(values, np.float64), axis=-1)
    cut = ordered.shape[-1] // 4
    return ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1)


def stratified_interval(
    strata: Sequence[Sequence[float]],
    statistic: Callable[[Any], Any] = interquartile_mean,
    *,
    repetitions: int = REPETITIONS,
    seed: int = 0,
) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval of a statistic.

    Args:
        strata: the values of each task, one for each run. Runs are drawn with replacement within each task.
        statistic: maps values (..., n) to (...,).
        repetitions: number of bootstrap samples.
        seed: seed of the samples.
    """
    rng = np.random.default_rng(seed)
    drawn: list[NDArray[Any]] = []
    for stratum in strata:
        chosen = rng.integers(0, len(stratum), (repetitions, len(stratum)))
        drawn.append(np.asarray(stratum)[chosen])
    low, high = np.percentile(statistic(np.concatenate(drawn, axis=1)), (2.5, 97.5))
    return float(low), float(high)


def to_csv(scores: Iterable[Score]) -> str:
    """Return scores as CSV text with a header."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(Score)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {
            name: round(value, 4) if isinstance(value, float) else value
            for name, value in asdict(score).items()
        }
        for score in scores
    )
    return text.getvalue()


def _score(key: _Key, values: Mapping[str, list[float]], error: float) -> Score:
    strata = list(values.values())
    iqm = float(interquartile_mean(np.concatenate(strata)))
    low, high = stratified_interval(strata)
    return Score(*key, iqm, low, high, error, len(strata), min(map(len, strata)))
