"""The policies in the package are what their records say."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from random_actors import random_actor
from safetensors.numpy import save_file

from imujoco_minari.cli.app import run
from imujoco_minari.envs.registration import make
from imujoco_minari.errors import PolicyError, PolicyNotFoundError, PolicyWarning
from imujoco_minari.policies import Actor, expert_actor, expert_record, expert_variants, policies_folder
from imujoco_minari.policies.experts import FOLDED, readable_record, shipped_folder
from imujoco_minari.policies.references import weakness_of
from imujoco_minari.policies.rollouts import episode_seed, roll_out
from imujoco_minari.policies.rungs import read_rung, rungs_of_robot
from imujoco_minari.policies.tiers import parts
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.training.run import CONFIRMING_SEED
from imujoco_minari.variants import ROBOTS, Variant, catalogue

# Not those of the person who runs the tests.
SHIPPED = expert_variants(shipped_folder())
BASE, LIGHT_LEG = Variant.parse("hopper-base"), Variant.parse("hopper-massdec_25_leggeom")
SHIPPED_RUNGS = rungs_of_robot(BASE)
# Enough to notice a wrong file, few enough for every run; a different few on every change of the list.
SAMPLE = random.Random(len(SHIPPED)).sample(SHIPPED, min(4, len(SHIPPED)))


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
        read_rung(variant, rung).check(variant.robot)


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_listed_variant_has_weights_of_its_own(robot: str) -> None:
    owners: dict[bytes, Variant] = {}
    for variant in (Variant(robot), *catalogue(robot)):
        weights = expert_actor(variant).weights
        # Own experts are stored in float16, so policies that differ by less are the same.
        stored = b"".join(weights[name].astype(np.float16).tobytes() for name in sorted(weights))
        assert owners.setdefault(stored, variant) == variant


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


def test_a_record_without_weights_is_named(home: Path) -> None:
    policies_folder().mkdir(parents=True)
    record = dict(expert_record(BASE)) | {"variant": "hopper-massinc_12_leggeom"}
    (policies_folder() / "hopper-massinc_12_leggeom.json").write_text(json.dumps(record))
    with pytest.raises(PolicyNotFoundError, match=r"but hopper-massinc_12_leggeom\.safetensors is missing"):
        expert_actor(Variant.parse("hopper-massinc_12_leggeom"))


EVALUATION = dict(expert_record(LIGHT_LEG)["evaluation"])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"variant": "walker2d-base"}, "its variant is 'walker2d-base'"),
        ({"algorithm": 5}, "algorithm must be a text"),
        ({"steps": "many"}, "steps must be a whole number, not 'many'"),
        ({"wall_seconds": float("nan")}, "wall_seconds must be a finite number"),
        ({"before": {"before": 7}}, "'wall_seconds' is missing"),
        ({"evaluation": "high"}, "evaluation must be a table"),
        ({"evaluation": EVALUATION | {"return_std": float("inf")}}, "evaluation/return_std must be a finite"),
        ({"evaluation": EVALUATION | {"return_mean": 10**400}}, "too large to convert"),
        ({"evaluation": EVALUATION | {"episodes": 0}}, "episodes must be 1 or more"),
        ({"random": {}}, "'episodes' is missing"),
        ({"ladder": 5}, "not iterable"),
        ({"ladder": [{"steps": 5, "run": "../../x", "evaluation": EVALUATION}]}, "malformed variant id"),
        ({"universal_sha256": "0"}, "belongs to folded policies"),
    ],
)
def test_a_record_with_wrong_values_is_named(home: Path, change: dict[str, Any], reason: str) -> None:
    policies_folder().mkdir(parents=True)
    text = json.dumps(dict(expert_record(LIGHT_LEG)) | change)
    (policies_folder() / f"{LIGHT_LEG}.json").write_text(text)
    with pytest.raises(
        PolicyError, match=rf"{LIGHT_LEG}\.json: not a training record: .*{re.escape(reason)}"
    ):
        expert_actor(LIGHT_LEG)
    with pytest.warns(PolicyWarning, match=rf"left out: .*{LIGHT_LEG}\.json"):
        assert readable_record(LIGHT_LEG) == {}


def grow(path: Path) -> None:
    """Give a file 5 GB, which take no space."""
    with path.open("wb") as file:
        file.truncate(5 * 2**30)


def test_a_record_of_any_size_or_depth_is_refused(home: Path) -> None:
    policies_folder().mkdir(parents=True)
    path = policies_folder() / f"{LIGHT_LEG}.json"
    path.write_text("[" * 100_000)
    with pytest.raises(PolicyError, match=r"json: not a training record"):
        expert_record(LIGHT_LEG)
    grow(path)
    with pytest.raises(PolicyError, match=r"json: not a training record: it has 5368709120 bytes"):
        expert_record(LIGHT_LEG)


@pytest.mark.parametrize("kind", ["pipe", "folder", "device", "nothing"])
@pytest.mark.parametrize("suffix", ["json", "safetensors"])
def test_what_is_no_file_is_named(home: Path, kind: str, suffix: str) -> None:
    policies_folder().mkdir(parents=True)
    path = policies_folder() / f"{LIGHT_LEG}.{suffix}"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero" if kind == "device" else "gone")
    with pytest.raises(PolicyError, match=rf"{LIGHT_LEG}\.{suffix} is not a regular file"):
        expert_actor(LIGHT_LEG)
    assert expert_actor(BASE).action_size == 3


def test_weights_of_any_size_and_those_of_another_record_are_refused(home: Path) -> None:
    policies_folder().mkdir(parents=True)
    path = policies_folder() / f"{LIGHT_LEG}.safetensors"
    save_file(dict(random_actor().weights), path)
    with pytest.raises(PolicyError, match=rf"{LIGHT_LEG}\.safetensors: these are not the weights"):
        expert_actor(LIGHT_LEG)
    grow(path)
    with pytest.raises(PolicyError, match=rf"{LIGHT_LEG}\.safetensors has 5368709120 bytes"):
        expert_actor(LIGHT_LEG)


def test_a_bad_record_keeps_no_other_policy_from_the_lists(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policies_folder().mkdir(parents=True)
    (policies_folder() / f"{LIGHT_LEG}.json").write_text("{}")
    (policies_folder() / "hopper-universal.safetensors").write_bytes(b"x")
    (policies_folder() / "hopper-universal.json").write_text("{}")
    (policies_folder() / "hopper-base.rung-last.safetensors").write_bytes(b"x")
    with pytest.warns(PolicyWarning) as warned:
        assert run(["policies", "--robot", "hopper", "--json"]) == 0
    for name in (f"{LIGHT_LEG}.json", "hopper-universal.json"):
        assert any(f"/{name}" in str(each.message) for each in warned)
    # The folded ones need the universal policy, whose record is bad too.
    own = {str(variant) for variant in catalogue("hopper") if variant in SHIPPED and variant != LIGHT_LEG}
    assert {record["variant"] for record in json.loads(capsys.readouterr().out)} == own
    with pytest.warns(PolicyWarning) as warned:
        assert run(["policies", "--robot", "hopper", "--summary"]) == 0
    assert any(f"/{LIGHT_LEG}.json" in str(each.message) for each in warned)
    assert capsys.readouterr().out.count("hopper") == 4
    assert run(["list", "--robot", "hopper", "--json"]) == 0
    printed = capsys.readouterr()
    assert len(json.loads(printed.out)) == 37
    assert "hopper-universal.json" in printed.err
    assert {rung.get("run") for rung in rungs_of_robot(BASE)} == {rung.get("run") for rung in SHIPPED_RUNGS}


def test_an_expert_that_nobody_has_evaluated_is_left_out_of_the_summary(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policies_folder().mkdir(parents=True)
    for suffix in ("json", "safetensors"):
        shutil.copy(shipped_folder() / f"hopper-universal.{suffix}", policies_folder())
    path = policies_folder() / "hopper-universal.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"measured": {}}))
    assert run(["policies", "--summary", "--robot", "hopper", "--json"]) == 0
    lines = json.loads(capsys.readouterr().out)
    own = [variant for variant in catalogue("hopper") if variant in SHIPPED]
    assert sum(line["policies"] for line in lines if line["category"] != "base") == len(own) < 37


def test_an_own_expert_that_started_from_the_universal_policy_is_published(home: Path, root: Path) -> None:
    policies_folder().mkdir(parents=True)
    record = dict(expert_record(LIGHT_LEG)) | {"start": FOLDED, "steps": 1000}
    (policies_folder() / f"{LIGHT_LEG}.json").write_text(json.dumps(record))
    assert "policy_told" not in read_metadata(publish(LIGHT_LEG, episodes=1).path / "data")
    assert weakness_of(LIGHT_LEG) == ""


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
