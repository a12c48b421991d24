"""Tiers are made by the policies that their records name, in equal parts, and say so on every episode."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import ANY

import minari
import numpy as np
import pytest
from random_actors import random_actor
from safetensors.numpy import save_file

from imujoco_minari.errors import DatasetError, PolicyNotFoundError
from imujoco_minari.policies import Actor, load_policy, policies_folder, references
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.experts import expert_record, shipped_folder
from imujoco_minari.policies.rungs import (
    LADDER_SEED,
    mean_return,
    medium_rung,
    read_rung,
    return_at,
    share_of,
)
from imujoco_minari.policies.tiers import parts
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.variants import Variant
from imujoco_minari.verification import verify

VARIANT = Variant.parse("hopper-massinc_37_torsogeom")
RUNGS = {100: 50.0, 200: 450.0, 300: 370.0, 400: 620.0, 500: 880.0, 600: 1200.0}


def scaled(factor: float) -> Actor:
    actor = random_actor()
    return Actor({name: (array * factor).astype(np.float32) for name, array in actor.weights.items()})


@pytest.fixture(autouse=True)
def trained(home: Path) -> None:
    """An expert that is said to make 1000, and a ladder of rungs, one of them above it."""
    folder = policies_folder()
    folder.mkdir(parents=True)
    save_file(dict(scaled(1.0).weights), folder / f"{VARIANT}.safetensors")
    shipped = expert_record(VARIANT.base, shipped_folder())
    expected = dict(shipped["evaluation"])
    ladder = []
    for steps, value in RUNGS.items():
        save_file(dict(scaled(1 + steps / 1000).weights), folder / f"hopper-base.rung-{steps}.safetensors")
        ladder.append({"steps": steps, "evaluation": expected | {"return_mean": value}})
    record = dict(shipped) | {
        "variant": str(VARIANT),
        "algorithm": "TQC",
        "weights_sha256": scaled(1.0).sha256,
        "evaluation": expected | {"return_mean": 1000.0},
        "random": expected | {"return_mean": 20.0},
        "ladder": ladder,
    }
    (folder / f"{VARIANT}.json").write_text(json.dumps(record))


def made(tier: str, episodes: int) -> list[tuple[str, int, dict[str, object]]]:
    found = parts(VARIANT, tier, episodes, path=None, stochastic=False)
    return [(part.policy.sha256, part.episodes, dict(part.attributes)) for part in found]


def rung(steps: int) -> str:
    return scaled(1 + steps / 1000).sha256


def test_medium_is_the_rung_nearest_to_its_share_of_the_experts_return() -> None:
    assert made("medium", 7) == [(rung(200), 7, {"rung": 200})]


def test_a_share_of_a_negative_return_is_counted_from_the_random_policys() -> None:
    walker, reacher = (
        {"evaluation": {"return_mean": best}, "random": {"return_mean": worst}}
        for best, worst in ((100.0, 10.0), (-10.0, -50.0))
    )
    assert (share_of(50.0, walker), return_at(0.5, walker)) == (0.5, 50.0)
    assert (share_of(-30.0, reacher), return_at(0.5, reacher)) == (0.5, -30.0)
    rungs = [{"steps": -value, "evaluation": {"return_mean": float(value)}} for value in (-12, -35, -48)]
    assert medium_rung(rungs, reacher)["steps"] == 35


def test_medium_expert_is_half_and_half() -> None:
    assert made("medium-expert", 10) == [
        (rung(200), 5, {"rung": 200, "part": "medium"}),
        (scaled(1.0).sha256, 5, {"part": "expert"}),
    ]
    with pytest.raises(DatasetError, match="7 episodes cannot be divided by 2"):
        made("medium-expert", 7)


def test_ranked_is_of_five_policies_best_first_none_above_the_expert() -> None:
    sets = made("ranked", 10)
    assert [(sha, count) for sha, count, _ in sets] == [
        (sha, 2) for sha in (scaled(1.0).sha256, rung(500), rung(400), rung(300), rung(100))
    ]
    assert [attributes["rank"] for *_, attributes in sets] == [0, 1, 2, 3, 4]
    returns = [attributes["policy_return"] for *_, attributes in sets]
    assert returns == sorted(returns, reverse=True)
    assert returns[0] == 1000.0
    assert 1200.0 not in returns


@pytest.mark.parametrize(("tier", "sha256"), [("medium", rung(200)), ("expert", scaled(1.0).sha256)])
def test_the_policy_of_a_tier_can_be_loaded(tier: str, sha256: str) -> None:
    policy = load_policy(VARIANT, tier=tier, stochastic=True)
    assert policy.sha256 == sha256
    assert not policy.deterministic
    assert policy.algorithm == "TQC"


def test_the_stochastic_expert_is_a_tier_that_states_its_own_return() -> None:
    policy = load_policy(VARIANT, tier="expert-stochastic")
    assert (policy.sha256, policy.deterministic) == (scaled(1.0).sha256, False)
    sampled = publish(VARIANT, tier="expert-stochastic", episodes=3)
    taken = publish(VARIANT, episodes=3)
    assert sampled.dataset_id == f"imujoco/{VARIANT}-expert-stochastic-v0"
    assert sampled.content_sha256 != taken.content_sha256
    assert publish(VARIANT, tier="expert-stochastic", episodes=3, jobs=2, force=True) == replace(
        sampled, seconds=ANY
    )
    for outcome, deterministic in ((sampled, False), (taken, True)):
        metadata = minari.load_dataset(outcome.dataset_id).storage.metadata
        returns = [float(episode.rewards.sum()) for episode in minari.load_dataset(outcome.dataset_id)]
        assert metadata["policy_deterministic"] is deterministic
        assert metadata["return_mean"] == pytest.approx(np.mean(returns), rel=1e-12)
        assert metadata["return_std"] == pytest.approx(np.std(returns), rel=1e-9)
        assert (verify(outcome.dataset_id), verify(outcome.dataset_id).exceptions) == ([], ())


@pytest.mark.parametrize(("tier", "count"), [("medium-expert", 2), ("ranked", 5)])
def test_a_tier_of_several_policies_says_how_to_get_them(tier: str, count: int) -> None:
    with pytest.raises(
        PolicyNotFoundError,
        match=rf"{count} policies make the tier '{tier}': .*parts\(\) .*valid here: expert, expert-stoch",
    ):
        load_policy(VARIANT, tier=tier)


def test_a_ranked_dataset_is_sound_and_carries_rank_and_return_and_the_same_with_two_jobs() -> None:
    outcome = publish(VARIANT, tier="ranked", episodes=10)
    dataset = minari.load_dataset(outcome.dataset_id)
    attributes = list(dataset.storage.get_episode_metadata(range(10)))
    assert [int(attrs["rank"]) for attrs in attributes] == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert len({int(attrs["seed"]) for attrs in attributes}) == 10
    assert {attrs["tier"] for attrs in attributes} == {"ranked"}
    assert verify(outcome.dataset_id) == []
    again = publish(VARIANT, tier="ranked", episodes=10, jobs=2, force=True)
    assert again.content_sha256 == outcome.content_sha256


def test_a_folded_expert_has_a_ladder_that_is_measured_once(monkeypatch: pytest.MonkeyPatch) -> None:
    variant = Variant.parse("hopper-massdec_13_footgeom")
    monkeypatch.setattr(references, "EPISODES", 2)
    monkeypatch.setattr(references, "LADDER_EPISODES", 1)
    rungs = references.ladder(variant)
    assert len(rungs) >= len(expert_record(Variant("hopper"))["ladder"]) > 5
    for rung in (rungs[0], rungs[-1]):
        again = evaluate(variant, read_rung(variant, rung), episodes=1, seed=LADDER_SEED)
        assert again.return_mean == rung["evaluation"]["return_mean"]
    returns = [mean_return(rung) for rung in rungs]
    assert returns == sorted(returns)
    (policy,) = (part.policy for part in parts(variant, "medium", 4, path=None, stochastic=False))
    assert policy.sha256 == read_rung(variant, medium_rung(rungs, expert_record(variant))).sha256
    assert policy.algorithm == expert_record(variant)["algorithm"] == "CrossQ"
    monkeypatch.setattr(references, "evaluate", None)
    assert references.ladder(variant) == rungs


def test_a_tier_that_cannot_be_made_says_what_can() -> None:
    with pytest.raises(
        PolicyNotFoundError,
        match=r"'medum' \(did you mean 'medium'\?\); valid: expert, expert-stochastic, medium, random",
    ):
        made("medum", 1)
    with pytest.raises(PolicyNotFoundError, match="--record-replay"):
        made("replay", 1)
    with pytest.raises(PolicyNotFoundError, match=r"with `imujoco publish \S+ --tier medium-replay`"):
        made("medium-replay", 1)
    with pytest.raises(PolicyNotFoundError, match="no expert policy exists for humanoid-base: train one"):
        parts(Variant("humanoid"), "medium", 1, path=None, stochastic=False)
