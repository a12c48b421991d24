"""The policies in the package are what their records say."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest

from imujoco_minari.envs.registration import make
from imujoco_minari.errors import PolicyError
from imujoco_minari.policies import (
    Actor,
    expert_actor,
    expert_record,
    expert_variants,
    policies_folder,
)
from imujoco_minari.policies.experts import FOLDED, shipped_folder
from imujoco_minari.policies.rollouts import episode_seed, roll_out
from imujoco_minari.policies.rungs import read_rung
from imujoco_minari.policies.tiers import parts
from imujoco_minari.training.run import CONFIRMING_SEED
from imujoco_minari.variants import Variant

SHIPPED = expert_variants()
# Enough to notice a wrong file, few enough for every run; a different few on every change of the list.
SAMPLE = random.Random(len(SHIPPED)).sample(SHIPPED, min(4, len(SHIPPED)))


def test_the_worked_example_and_a_base_are_shipped() -> None:
    assert {Variant.parse("hopper-massdec_25_leggeom"), Variant.parse("hopper-base")} <= set(SHIPPED)


@pytest.mark.parametrize("variant", SHIPPED, ids=str)
def test_a_record_is_of_the_weights_beside_it(variant: Variant) -> None:
    record, actor = expert_record(variant), expert_actor(variant)
    actor.check(variant.robot)
    assert actor.sha256 == record["weights_sha256"]
    assert record["variant"] == str(variant)
    assert record["evaluation"]["episodes"] >= 100
    assert record["evaluation"]["deterministic"]
    assert record["random"]["episodes"] >= 100
    # Earlier experts began as the base's agent, one trained on all variants, or another expert.
    assert record["start"] in ("scratch", FOLDED) or record["start"].startswith(f"{variant.robot}-")
    assert len(record["ladder"]) >= 4
    for rung in record["ladder"]:
        read_rung(variant, rung, shipped_folder()).check(variant.robot)


@pytest.mark.parametrize("variant", SAMPLE, ids=str)
def test_an_expert_scores_what_its_record_says(variant: Variant) -> None:
    evaluation: dict[str, Any] = expert_record(variant)["evaluation"]
    assert evaluation["seed"] == CONFIRMING_SEED
    env = make(variant)
    returns = [roll_out(env, expert_actor(variant), episode_seed(CONFIRMING_SEED, i))[0] for i in range(2)]
    slack = 0.02 * abs(evaluation["return_mean"])
    assert all(
        evaluation["return_min"] - slack <= value <= evaluation["return_max"] + slack for value in returns
    )
    # Seeds that nobody has looked at.
    strange = [roll_out(env, expert_actor(variant), seed)[0] for seed in (123_456_789, 987_654_321)]
    assert max(strange) >= evaluation["return_mean"] - 3 * evaluation["return_std"] - slack


@pytest.mark.parametrize("text", ["[]", "5", "{", '"record"'])
def test_a_damaged_record_is_named(home: Path, text: str) -> None:
    policies_folder().mkdir(parents=True)
    (policies_folder() / "hopper-base.json").write_text(text)
    with pytest.raises(PolicyError, match=r"hopper-base\.json: not a training record"):
        expert_actor(Variant.parse("hopper-base"))


@pytest.mark.parametrize("tier", ["expert", "medium", "medium-expert", "ranked", "random"])
def test_every_tier_of_the_worked_example_can_be_made(tier: str) -> None:
    made = parts(Variant.parse("hopper-massdec_25_leggeom"), tier, 100, path=None, stochastic=False)
    assert sum(part.episodes for part in made) == 100
    assert len({part.policy.sha256 for part in made}) == len(made)
    if tier == "ranked":
        returns = [part.attributes["policy_return"] for part in made]
        assert returns == sorted(returns, reverse=True)
        assert returns[0] > 1.5 * returns[-1]
        assert all(isinstance(part.policy, Actor) for part in made)
