"""What the REPL shows of every public object: one short line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import imujoco_minari
from imujoco_minari import (
    Ranges,
    Sampler,
    arrays,
    bases,
    catalogue,
    evaluate,
    export,
    few_shot,
    held_out,
    load_policy,
    normalized_score,
    off_dynamics,
    off_dynamics_names,
    publish,
    randomised,
    verify,
)
from imujoco_minari.benchmark import METHODS, Budget, FewShotGrid, MethodScore, OfflineGrid
from imujoco_minari.envs.categories import BY_NAME, Edit
from imujoco_minari.envs.differences import differences
from imujoco_minari.exporting.torch import TransitionDataset, WindowDataset
from imujoco_minari.loading import (
    episode_batches,
    preference_pairs,
    transition_batches,
    transition_samples,
    window_batches,
)
from imujoco_minari.pictures.gallery import Built
from imujoco_minari.pictures.rendering import Motion
from imujoco_minari.policies import universal_policy
from imujoco_minari.policies.transfer import Transfer
from imujoco_minari.publishing.removal import Deleted
from imujoco_minari.remotes import Pulled, Pushed
from imujoco_minari.variants import Variant, held_out_names, known_robots, specification
from imujoco_minari.variants.named_collections import NamedCollection
from imujoco_minari.variants.original import OriginalVariant
from imujoco_minari.variants.ranges import drawing_ranges
from imujoco_minari.verification import Finding, Findings

DAMAGED = Variant.parse("hopper-massinc_50_torsogeom-frictiondec_50_feet")


def assert_short(shown: Any) -> None:
    for text in (repr(shown), str(shown)):
        assert 0 < len(text) < 300, text
        assert " at 0x" not in text
        assert "\n" not in text


def test_variants() -> None:
    changed = OriginalVariant.parse("hopper-massdec_25_leggeom")
    for shown in (DAMAGED, *DAMAGED.changes, changed, NamedCollection("hopper", "mass"), bases()):
        assert_short(shown)
    assert repr(changed) == "OriginalVariant.parse('hopper-massdec_25_leggeom')"
    assert eval(repr(DAMAGED)) == DAMAGED


@pytest.mark.parametrize("robot", known_robots())
def test_pages(robot: str) -> None:
    page = specification(robot)
    assert_short(page)
    for listing in page.categories.values():
        assert_short(listing)
    assert_short(Ranges(robot, drawing_ranges(robot, unlisted=True)))
    for name in held_out_names(robot):
        assert_short(held_out(name))


def test_splits_and_tasks() -> None:
    for name in held_out_names():
        assert_short(held_out(name))
    for name in off_dynamics_names():
        assert_short(off_dynamics(name))
    assert "train=<34: 'hopper-massdec_50_torsogeom', ...>" in repr(held_out("hopper-friction-v1"))


def test_categories() -> None:
    for law in BY_NAME.values():
        assert_short(law)
    base = imujoco_minari.make("hopper-base").unwrapped
    assert_short(Edit(None, ("a",), 1.5, specification("hopper"), base.model))  # type: ignore[attr-defined]
    for difference in differences(DAMAGED):
        assert_short(difference)


def test_environments() -> None:
    for env in (
        imujoco_minari.make(DAMAGED),
        randomised("hopper"),
        gym.make("imujoco/hopper-all-v0"),
        gym.make("imujoco/ant-base-v0"),
    ):
        assert_short(env)
        assert_short(env.unwrapped)
    assert repr(imujoco_minari.make(DAMAGED).unwrapped) == f"HopperVariantEnv({DAMAGED})"


def test_arrays_and_batches(small_datasets: list[str], tmp_path: Path) -> None:
    data = arrays(small_datasets, normalize=True)
    batches = (transition_batches, transition_samples, episode_batches)
    for shown in (
        data,
        data.statistics,
        *data.table,
        data.trajectory(0),
        *(next(iter(each(data, 8))) for each in batches),
        next(window_batches(data, 3, 8)),
        *(few_shot(data, shots=1), Sampler(data), Sampler(data).sample(2)),
        Sampler(data, torch=True).sample(1),
        preference_pairs(data, pairs=5, length=3),
        *(TransitionDataset(data), WindowDataset(data, 3)),
        export(data, "npz", tmp_path / "hopper.npz"),
    ):
        assert_short(shown)
    assert repr(next(window_batches(data, 3, 8))).startswith("Windows(observations=float64 (8, 3, 11), ")


def test_policies_and_scores() -> None:
    policy, universal = load_policy("hopper-base"), universal_policy("hopper")
    for shown in (policy, load_policy("hopper-base", tier="random"), universal):
        assert_short(shown)
    result = evaluate("hopper-base", policy, episodes=2)
    matrix = {("hopper-base", variant): result for variant in catalogue("hopper")}
    assert_short(result)
    assert_short(Transfer(("hopper-base",), catalogue("hopper"), matrix))
    assert_short(normalized_score("hopper-base", 1000.0))


def test_outcomes(root: Path) -> None:
    published = publish("hopper-massdec_25_leggeom", tier="random", episodes=2)
    name, folder = published.dataset_id, root.joinpath(*["folder"] * 30)
    findings = Findings([Finding("episode_0/observations", "is text, " + "not numbers " * 50)] * 100)
    for shown in (
        published,
        Pushed(name, folder, "", False, "hf://someone", True, 2**40, "0" * 64, 1 / 3),
        Pulled(name, folder, "an error " * 100, False, "hf://someone", True, "0" * 64, False, 1 / 3),
        Deleted(name, error="it has links"),
        *(verify(name), findings, Findings(exceptions=["it was collected by other versions"])),
        Motion(DAMAGED, np.zeros((1001, 6)), np.zeros(1000), 0.008, False, mjcf="<mujoco/>" * 1000),
        Built(folder, 157, 3, {str(variant): "an error" for variant in catalogue()}),
    ):
        assert_short(shown)
    assert repr(verify(name)) == "<sound>"
    assert repr(published).startswith(f"Published(dataset_id={name!r}, path=PosixPath('")


def test_benchmark() -> None:
    for shown in (
        *(method(0) for method in METHODS.values()),
        *(Budget(5, 100), OfflineGrid()),
        FewShotGrid(METHODS, [held_out(name) for name in held_out_names("hopper")]),
        MethodScore(
            *("hopper-friction-v1", "expert", "base-expert", "5x100", 2000, "all"),
            *(1 / 3, 1 / 3, 1 / 3, 1 / 3, 1 / 3, 1 / 3, 154, 5),
        ),
    ):
        assert_short(shown)
