"""What the gallery tells of a variant: what it changes, and what its policies and datasets score."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np

from imujoco_minari.envs.differences import Difference, differences
from imujoco_minari.envs.registration import make
from imujoco_minari.errors import VariantError
from imujoco_minari.policies import RandomPolicy, expert_record
from imujoco_minari.policies.rollouts import evaluate
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.variants import BASE, EXPERT, NAMESPACE, Variant, parse_dataset_id, specification

RANDOM = "random"
# Enough to place a random policy, whose exact return nobody looks for; a record holds more.
RANDOM_EPISODES = 10


@dataclass(frozen=True)
class Score:
    """What one tier of a variant scores.

    Attributes:
        tier: name of the tier.
        algorithm: what made its policy.
        return_mean: mean undiscounted return.
        return_std: its standard deviation over episodes.
        length_mean: mean length of an episode, in steps.
        episodes: how many episodes that is of.
        origin: where the numbers come from, in a few words.
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
    """What a variant's video shows.

    Attributes:
        tier: which policy moves the robot.
        seconds: how long it moves.
        total: return of what is shown.
        ended: whether the episode ended there, as the robot left its healthy range.
    """

    tier: str
    seconds: float
    total: float
    ended: bool


@dataclass(frozen=True)
class Entry:
    """All that the gallery tells of one variant."""

    variant: Variant
    changes: tuple[Difference, ...]
    scores: tuple[Score, ...]
    clip: Clip

    @property
    def best(self) -> Score:
        """The score that a variant is sorted by: its expert's, else the highest."""
        expert = [score for score in self.scores if score.tier == EXPERT]
        return expert[0] if expert else max(self.scores, key=lambda score: score.return_mean)


def changes(variant: Variant) -> tuple[Difference, ...]:
    """Return what a variant changes, in numbers; nothing for a base robot."""
    return () if variant.category == BASE else tuple(differences(variant))


def scores(variant: Variant, random: Score | None = None) -> tuple[Score, ...]:
    """Return the scores of a variant's tiers: of its expert's record, its random policy and its datasets.

    Args:
        variant: which variant.
        random: the random policy's score, where it was measured before.
    """
    record = expert_record(variant)
    found: dict[str, Score] = {}
    if "evaluation" in record:
        found[EXPERT] = _of_record(EXPERT, str(record["algorithm"]), record["evaluation"])
    for score in published_scores(variant):
        found.setdefault(score.tier, score)
    if "random" in record:
        found[RANDOM] = _of_record(RANDOM, "uniform actions", record["random"])
    else:
        found.setdefault(RANDOM, random or measured_random(variant))
    return tuple(sorted(found.values(), key=lambda score: -score.return_mean))


def measured_random(variant: Variant) -> Score:
    """Roll the random policy out and return what it scores."""
    env, policy = make(variant), RandomPolicy(specification(variant.robot).action_size)
    try:
        outcome = evaluate(env, policy, episodes=RANDOM_EPISODES)
    finally:
        env.close()
    return _of_record(RANDOM, "uniform actions", outcome.asdict(), "measured for this page")


def published_scores(variant: Variant) -> Iterator[Score]:
    """Yield the score of each dataset of a variant that is published here."""
    for folder in sorted((minari_root.datasets_root() / NAMESPACE).glob(f"{variant}*-v0")):
        try:
            found, tier = parse_dataset_id(f"{NAMESPACE}/{folder.name}")
        except VariantError:
            continue
        if found == variant:
            # A dataset that cannot be read is not this page's to complain of: `imujoco verify` does.
            try:
                yield _of_dataset(folder / "data", tier)
            except (OSError, KeyError, ValueError):
                continue


def _of_record(tier: str, algorithm: str, evaluation: Any, origin: str = "evaluation of the policy") -> Score:
    return Score(
        tier,
        algorithm,
        float(evaluation["return_mean"]),
        float(evaluation["return_std"]),
        float(evaluation["length_mean"]),
        int(evaluation["episodes"]),
        origin,
    )


def _of_dataset(data: Any, tier: str) -> Score:
    metadata = json.loads((data / "metadata.json").read_text("utf-8"))
    with h5py.File(file_format.main_file(data), "r") as file:
        attributes = [file[name].attrs for name in file]
        returns = np.array([attrs["rewards_sum"] for attrs in attributes])
        lengths = np.array([attrs["total_steps"] for attrs in attributes])
    return Score(
        tier,
        str(metadata.get("algorithm_name", "unknown")),
        float(returns.mean()),
        float(returns.std()),
        float(lengths.mean()),
        len(returns),
        "the published dataset",
    )
