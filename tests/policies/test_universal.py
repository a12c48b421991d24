"""Folding: the universal policy with a constant context is an ordinary actor, for every variant."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from imujoco_minari import load_policy, publish
from imujoco_minari.errors import PolicyError, PolicyNotFoundError
from imujoco_minari.policies import Actor, expert_record, own_record, universal_policy
from imujoco_minari.policies.experts import FOLDED, shipped_folder
from imujoco_minari.policies.references import measured_record, weakness_of
from imujoco_minari.policies.standing import seconds_trained
from imujoco_minari.policies.universal import read_universal, whole_context
from imujoco_minari.variants import ROBOTS, Variant, catalogue, specification
from imujoco_minari.variants.context import parameters

UNLISTED = "hopper-massinc_37_torsogeom"


def outputs(weights: dict[str, np.ndarray], inputs: np.ndarray) -> np.ndarray:
    """The network written out in float64: the mode of the action for rows of inputs."""
    for layer in ("latent_pi.0", "latent_pi.2"):
        inputs = np.maximum(
            inputs @ np.float64(weights[f"{layer}.weight"]).T + np.float64(weights[f"{layer}.bias"]), 0
        )
    return np.tanh(inputs @ np.float64(weights["mu.weight"]).T + np.float64(weights["mu.bias"]))


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_folded_policy_acts_as_the_universal_one_in_every_variant(robot: str) -> None:
    universal = universal_policy(robot)
    assert universal is not None
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(50, specification(robot).observation_size)).astype(np.float32)
    compound = [Variant(robot, (a.changes[0], b.changes[0])) for a, b in _pairs(robot)]
    for variant in (Variant(robot), *catalogue(robot), *compound):
        told = np.clip(whole_context(variant), universal.low, universal.high)
        inputs = np.concatenate([observations, np.tile(told, (50, 1))], axis=1)
        expected = outputs(dict(universal.actor.weights), inputs)
        folded = universal.fold(variant)
        assert folded.observation_size == observations.shape[1]
        assert folded.hidden_sizes == universal.actor.hidden_sizes
        acted = folded.act(observations, rng)
        assert acted == pytest.approx(expected, abs=2e-5)


def _pairs(robot: str) -> list[tuple[Variant, Variant]]:
    listed = catalogue(robot)
    return [
        (a, b)
        for a, b in zip(listed, reversed(listed), strict=True)
        if (a.category, a.body) != (b.category, b.body)
    ][:10]


def test_a_context_has_every_parameter_and_a_group_is_its_bodies() -> None:
    names = parameters("halfcheetah")
    variant = Variant.parse("halfcheetah-massinc_50_back-gravitydec_20_world")
    told = dict(zip(names, whole_context(variant).tolist(), strict=True))
    assert {name: value for name, value in told.items() if value} == {
        "mass/bthigh": 0.5,
        "mass/bshin": 0.5,
        "mass/bfoot": 0.5,
        "gravity/world": -0.2,
    }
    assert not whole_context(Variant("halfcheetah")).any()


def test_every_id_has_an_expert_that_says_what_it_was_told() -> None:
    record = expert_record(Variant.parse(UNLISTED))
    assert record["start"] == FOLDED
    assert record["told"] == {"mass/torsogeom": 37}
    assert own_record(Variant.parse(UNLISTED)) == {}
    assert seconds_trained(expert_record(Variant.parse(UNLISTED))) == 0
    policy = load_policy(UNLISTED)
    assert isinstance(policy, Actor)
    assert policy.sha256 == record["weights_sha256"]
    assert load_policy("hopper-massinc_37_torsogeom-lengthinc_12_leggeom").sha256 != policy.sha256
    # What was never trained is told as the end of the range.
    far = expert_record(Variant.parse("hopper-massinc_900_torsogeom"))
    assert far["told"]["mass/torsogeom"] < 900


def test_a_robot_without_a_universal_policy_says_how_to_get_an_expert() -> None:
    assert expert_record(Variant("humanoid")) == {}
    with pytest.raises(PolicyNotFoundError, match="imujoco train humanoid-base"):
        load_policy("humanoid-base")


@pytest.mark.filterwarnings("ignore::imujoco_minari.errors.PolicyWarning")
def test_the_dataset_states_the_universal_policy_and_the_reference_is_measured_once(home: Path) -> None:
    import minari

    outcome = publish(UNLISTED, episodes=2)
    metadata = minari.load_dataset(outcome.dataset_id).storage.metadata
    universal = universal_policy("hopper")
    assert universal is not None
    assert metadata["universal_sha256"] == universal.sha256
    assert dict(metadata["policy_told"]) == {"mass/torsogeom": 37}
    assert "told the variant" in metadata["description"]
    kept = json.loads((home / "measured" / f"{UNLISTED}.json").read_text())
    assert metadata["ref_max_score"] == kept["evaluation"]["return_mean"]
    assert kept["evaluation"]["episodes"] == 100
    assert measured_record(Variant.parse(UNLISTED))["evaluation"] == kept["evaluation"]


def test_a_weak_folded_expert_is_named_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    records = {
        UNLISTED: {"universal_sha256": "0", "evaluation": {"return_mean": 900.0, "length_mean": 800.0}},
        "hopper-base": {"start": "scratch", "evaluation": {"return_mean": 3000.0, "length_mean": 1000.0}},
    }
    monkeypatch.setattr(
        "imujoco_minari.policies.references.measured_record", lambda variant: records[str(variant)]
    )
    weakness = weakness_of(Variant.parse(UNLISTED))
    assert "0.30 of the base expert's return and falls in some episodes" in weakness
    assert f"imujoco train {UNLISTED}" in weakness
    records[UNLISTED]["evaluation"] = {"return_mean": 2900.0, "length_mean": 1000.0}
    assert weakness_of(Variant.parse(UNLISTED)) == ""


@pytest.mark.parametrize("text", ["[]", "x"])
def test_a_broken_record_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "hopper-universal.safetensors").write_bytes(b"")
    with pytest.raises(PolicyNotFoundError, match=r"hopper-universal\.json is missing"):
        read_universal(tmp_path / "hopper-universal.safetensors")
    (tmp_path / "hopper-universal.json").write_text(text)
    with pytest.raises(PolicyError, match="not the record of a universal policy"):
        read_universal(tmp_path / "hopper-universal.safetensors")


def test_episodes_of_ranges_are_acted_by_the_policy_that_is_told_what_was_drawn(root: Path) -> None:
    import minari

    from imujoco_minari import Ranges, verify

    ranges = Ranges("hopper", {"mass/torsogeom": (-50, 200), "gravity/world": (-20, 20)})
    outcome = publish(ranges, episodes=3, jobs=2)
    assert verify(outcome.dataset_id) == []
    dataset = minari.load_dataset(outcome.dataset_id)
    universal = universal_policy("hopper")
    assert universal is not None
    assert dataset.storage.metadata["policy_sha256"] == universal.sha256
    stated = list(dataset.storage.get_episode_metadata(range(3)))
    for episode, attributes in zip(dataset, stated, strict=True):
        told = universal.fold(Variant.parse(attributes["variant"]))
        seen = episode.observations[:-1]
        assert episode.actions == pytest.approx(told.act(seen, np.random.default_rng(0)), abs=1e-5)
    other = universal.fold(Variant("hopper")).act(dataset[0].observations[:-1], np.random.default_rng(0))
    assert np.abs(dataset[0].actions - other).max() > 0.01


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"ranges": {}}, "'mass/torsogeom' is missing"),
        ({"ranges": 3}, "TypeError"),
        ({"algorithm": 3}, "algorithm a text"),
        ({"measured": []}, "measured must be a table"),
        ({"measured": None}, "measured must be a table"),
        ({"measured": {"hopper-base": None}}, "the evaluations must be a table"),
        ({"robot": "horse"}, "unknown robot 'horse'"),
        ("[nan, 1]", "two finite numbers"),
        ("[1, 1e999]", "two finite numbers"),
        ("[2, 1]", "the lower one first"),
        ("[0, 1, 2]", "inhomogeneous"),
        (f"[0, 1{'0' * 400}]", "OverflowError"),
        ("[" * 100_000, "RecursionError"),
    ],
)
def test_a_malformed_record_is_named_in_one_line(
    change: dict[str, object] | str, words: str, tmp_path: Path
) -> None:
    for suffix in (".json", ".safetensors"):
        shutil.copy(shipped_folder() / f"hopper-universal{suffix}", tmp_path)
    path = tmp_path / "hopper-universal.json"
    record = json.loads(path.read_text())
    if isinstance(change, str):
        record["ranges"]["mass/torsogeom"] = "HERE"
        text = json.dumps(record).replace('"HERE"', change.replace("nan", "NaN"))
    else:
        text = json.dumps(record | change)
    path.write_text(text)
    with pytest.raises(PolicyError, match=words) as caught:
        read_universal(path.with_suffix(".safetensors"))
    assert len(str(caught.value)) < 400 + len(str(path))
    assert "\n" not in str(caught.value)


def test_files_of_another_robot_are_named(tmp_path: Path) -> None:
    for ending in ("json", "safetensors"):
        file = tmp_path / f"hopper-universal.{ending}"
        file.write_bytes((shipped_folder() / f"walker2d-universal.{ending}").read_bytes())
    with pytest.raises(PolicyError, match="this is the universal policy of walker2d, not of hopper"):
        universal_policy("hopper", tmp_path)


def test_weights_of_any_size_are_not_read(tmp_path: Path) -> None:
    shutil.copy(shipped_folder() / "hopper-universal.json", tmp_path)
    with (tmp_path / "hopper-universal.safetensors").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(PolicyError, match=f"has {2**40} bytes; the limit is"):
        universal_policy("hopper", tmp_path)
