"""The facts that the gallery shows about a variant: its changes, and scores of policies and datasets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.envs.differences import Difference
from imujoco_minari.errors import VariantError
from imujoco_minari.policies import random_policy
from imujoco_minari.policies.evaluation import Evaluation, evaluate
from imujoco_minari.policies.references import measured_record
from imujoco_minari.policies.tiers import RANDOM
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.storage.reader import EpisodeFile
from imujoco_minari.variants import EXPERT, NAMESPACE, Variant, parse_dataset_id

# Caption, columns and rows of a table of results.
ResultTable = tuple[str, Sequence[str], Sequence[Sequence[str]]]
# A rough return is enough for a random policy. Records have a more exact one.
RANDOM_EPISODES = 10


@dataclass(frozen=True)
class Score:
    """The score of one tier of a variant: undiscounted returns, and the mean length in steps.

    ``algorithm`` trained the policy. ``origin`` is the source of the numbers, in a few words.
    """

    tier: str
    algorithm: str
    return_mean: float
    return_std: float
    length_mean: float
    episodes: int
    origin: str


@dataclass(frozen=True)
class Clip:
    """The content of a variant's video: the tier of the policy, the simulated seconds, and the return.

    ``ended`` is whether the episode ended because the robot left its healthy range.
    """

    tier: str
    seconds: float
    total: float
    ended: bool


@dataclass(frozen=True)
class Entry:
    """All facts that the gallery shows about one variant."""

    variant: Variant
    changes: tuple[Difference, ...]
    scores: tuple[Score, ...]
    clip: Clip

    @property
    def best(self) -> Score:
        """The score that sorts the variant: the expert's, or else the highest."""
        return self.score(EXPERT) or max(self.scores, key=lambda score: score.return_mean)

    def score(self, tier: str) -> Score | None:
        """Return the score of a tier, or None if there is none."""
        return next((score for score in self.scores if score.tier == tier), None)


def normalised(score: Score, base: Entry | None) -> float | None:
    """Return a return on the scale of the base robot: 0 is its random policy, 1 its expert.

    A variant's own expert would always be 1. None if the base robot has no expert.
    """
    if base is None:
        return None
    expert, random = base.score(EXPERT), base.score(RANDOM)
    if expert is None or random is None:
        return None
    return (score.return_mean - random.return_mean) / (expert.return_mean - random.return_mean)


def scores(variant: Variant) -> tuple[Score, ...]:
    """Return the scores of a variant's tiers, highest first.

    They come from the expert's record, the published datasets and the random policy.
    """
    record = measured_record(variant)
    found: dict[str, Score] = {}
    if "evaluation" in record:
        found[EXPERT] = _score(EXPERT, str(record["algorithm"]), record["evaluation"])
    for score in published_scores(variant):
        found.setdefault(score.tier, score)
    if "random" in record:
        found[RANDOM] = _score(RANDOM, "uniform actions", record["random"])
    elif RANDOM not in found:
        outcome = evaluate(variant, random_policy(variant.robot), episodes=RANDOM_EPISODES).asdict()
        found[RANDOM] = _score(RANDOM, "uniform actions", outcome, "measured for this page")
    return tuple(sorted(found.values(), key=lambda score: -score.return_mean))


def published_scores(variant: Variant) -> Iterator[Score]:
    """Yield the score of each dataset of a variant in the Minari root."""
    for folder in sorted((minari_root.datasets_root() / NAMESPACE).glob(f"{variant}*-v0")):
        try:
            found, tier = parse_dataset_id(f"{NAMESPACE}/{folder.name}")
        except VariantError:
            continue
        if found == variant:
            # Skip a dataset that cannot be read. `imujoco verify` reports it.
            try:
                yield _score_from_dataset(folder / "data", tier)
            except (OSError, KeyError, RuntimeError, TypeError, ValueError):
                continue


def _score(tier: str, algorithm: str, evaluation: Any, origin: str = "evaluation of the policy") -> Score:
    return Score(
        tier,
        algorithm,
        float(evaluation["return_mean"]),
        float(evaluation["return_std"]),
        float(evaluation["length_mean"]),
        int(evaluation["episodes"]),
        origin,
    )


def _score_from_dataset(data: Path, tier: str) -> Score:
    algorithm = str(read_metadata(data)["algorithm_name"])
    names = ("rewards_sum", "total_steps")
    with EpisodeFile(file_format.main_file(data), data.parent.name) as file:
        episodes = [file.episode_attributes(number, names) for number in file.numbers()]
    # A dataset without episodes has no columns, so this raises a ValueError.
    returns, lengths = np.array([[episode[name] for name in names] for episode in episodes], float).T
    return _score(tier, algorithm, Evaluation(returns, lengths, ()).asdict(), "the published dataset")
