"""The context that a universal policy is told: listed ones are compared, and a search goes beyond them."""

from __future__ import annotations

import numpy as np
import pytest

from imujoco_minari.policies import universal_policy
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.training import context_search
from imujoco_minari.training.context_search import best_told, search_contexts
from imujoco_minari.variants import Variant

HEAVY = Variant.parse("hopper-massinc_100_torsogeom")


def test_a_universal_policy_is_told_what_makes_it_act_best() -> None:
    policy = universal_policy("hopper")
    assert policy is not None
    others = [
        Variant.parse(f"hopper-{name}") for name in ("gravityinc_100_world", "gravitydec_50_world", "base")
    ]
    found = best_told(policy, HEAVY, [*others, HEAVY])
    assert len(found) == 3
    returns = {each: evaluate(HEAVY, policy.fold(each), episodes=1, seed=0).return_mean for each in found}
    (left_out,) = {*others, HEAVY} - set(found)
    left = evaluate(HEAVY, policy.fold(left_out), episodes=1, seed=0).return_mean
    assert left < min(returns.values())


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes of 100 steps, so that a generation takes a moment."""
    monkeypatch.setattr(context_search, "max_episode_steps", lambda robot: 100)
    monkeypatch.setattr(context_search, "_EVERY", 4)


def test_a_search_finds_what_a_bad_context_lacks(short: None) -> None:
    pytest.importorskip("cmaes")
    policy = universal_policy("hopper")
    assert policy is not None
    # Told that gravity is far stronger, the policy acts worse than when it is told the truth.
    bad = policy.context(Variant.parse("hopper-gravityinc_100_world"))
    first, last = search_contexts(policy, HEAVY, bad, 8)
    assert first.shape == last.shape == bad.shape
    before, after = context_search._returns(policy, HEAVY, np.array([bad, last]), seed=0)
    assert after > before
    again = search_contexts(policy, HEAVY, bad, 4)
    np.testing.assert_array_equal(again[0], first)
