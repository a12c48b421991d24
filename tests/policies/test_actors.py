"""Actors in NumPy act as Stable-Baselines3's do, and foreign files are refused in one line."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from random_actors import random_actor
from safetensors.numpy import save_file

from imujoco_minari.envs.registration import make
from imujoco_minari.errors import DatasetExistsError, PolicyError
from imujoco_minari.policies import Actor, RandomPolicy, load_policy, read_actor
from imujoco_minari.policies.sb3 import export_zip
from imujoco_minari.storage.metadata import processor
from imujoco_minari.variants import Variant

HOPPER = Variant.parse("hopper-massdec_25_leggeom")


@pytest.fixture
def observations() -> Any:
    return np.random.default_rng(1).normal(size=(50, 11)) * 3


@pytest.mark.parametrize(
    ("widths", "activation"),
    [((256, 256), "ReLU"), ((64,), "Tanh"), ((32, 48, 16), "ELU"), ((40, 40), "SiLU")],
)
def test_an_exported_zip_predicts_as_the_actor_acts_and_reads_back(
    tmp_path: Path, observations: Any, widths: tuple[int, ...], activation: str
) -> None:
    from stable_baselines3 import SAC

    actor = random_actor(widths=widths, activation=activation)
    path = export_zip(HOPPER, tmp_path / "actor", actor)
    assert path.name == "actor.zip"
    model = SAC.load(path, device="cpu")
    rng = np.random.default_rng(0)
    for observation in observations:
        predicted, _ = model.predict(observation, deterministic=True)
        assert actor.act(observation, rng) == pytest.approx(predicted, abs=1e-5)
    # Training can go on: the loaded model has the usual buffer.
    assert model.buffer_size == model.replay_buffer.buffer_size == 1_000_000
    read = read_actor(path)
    assert read.sha256 == actor.sha256
    assert read.activation == activation
    assert read.algorithm == "SAC"


def test_an_exported_zip_replaces_no_zip_of_others(tmp_path: Path) -> None:
    path = export_zip(HOPPER, tmp_path / "mine.zip", random_actor())
    with pytest.raises(DatasetExistsError, match=r"mine.zip already exists; it was not changed"):
        export_zip(HOPPER, path, random_actor())
    export_zip(HOPPER, path, random_actor(), force=True)
    with zipfile.ZipFile(path, "a") as trained:
        trained.comment = b""
    before = path.read_bytes()
    with pytest.raises(
        DatasetExistsError, match=r"mine.zip was not replaced: it is not an export of imujoco"
    ):
        export_zip(HOPPER, path, random_actor(), force=True)
    assert path.read_bytes() == before


def test_an_action_has_the_same_bits_in_whatever_company(observations: Any) -> None:
    rngs = [np.random.default_rng(row) for row in range(50)]
    for deterministic in (True, False):
        actor = random_actor(deterministic=deterministic)
        alone = [actor.act(row, np.random.default_rng(i)) for i, row in enumerate(observations)]
        together = actor.act_together(observations, [np.random.default_rng(row) for row in range(50)])
        assert together.tobytes() == np.array(alone).tobytes()
        for count in (1, 2, 7, 16):
            chosen = actor.act_together(observations[-count:], rngs[-count:])
            assert not deterministic or chosen.tobytes() == together[-count:].tobytes()
    assert (
        random_actor().act(observations).tobytes() == random_actor().act_together(observations, []).tobytes()
    )


# Computed on a processor without AVX-512.
KNOWN = "e356b77a7a211b68d20de86b48f2b465859f68c940d470186b3f363a75ed825e"
ACT = """
import hashlib
import numpy as np
from random_actors import random_actor

digest, rng = hashlib.sha256(), np.random.default_rng(0)
for activation in ("ReLU", "Tanh", "ELU", "SiLU"):
    for deterministic in (True, False):
        actor = random_actor(activation=activation, deterministic=deterministic)
        digest.update(actor.act(2 * rng.standard_normal((200, 11)), rng).tobytes())
print(digest.hexdigest())
"""


@pytest.mark.parametrize("seen_as", ["it is", "Haswell", "Nehalem", "without SIMD", "with three threads"])
def test_the_bits_of_actions_are_the_same_on_every_processor(seen_as: str) -> None:
    # The kernels of BLAS and of NumPy are those of other processors.
    changed = {
        "it is": {},
        "without SIMD": {
            "NPY_DISABLE_CPU_FEATURES": " ".join(processor()["simd"]),
            "OPENBLAS_CORETYPE": "Prescott",
        },
        "with three threads": {"OPENBLAS_NUM_THREADS": "3"},
    }.get(seen_as, {"OPENBLAS_CORETYPE": seen_as})
    tests = str(Path(__file__).parents[1])
    said = subprocess.run(
        [sys.executable, "-c", ACT],
        env=os.environ | changed | {"PYTHONPATH": tests},
        capture_output=True,
        text=True,
        check=True,
    )
    assert said.stdout.strip() == KNOWN


def test_a_stochastic_actor_samples_about_its_mode_and_repeats_by_seed(observations: Any) -> None:
    mode, sampler = random_actor(), random_actor(deterministic=False)
    draws = np.array([sampler.act(observations[0], np.random.default_rng(seed)) for seed in range(400)])
    again = np.array([sampler.act(observations[0], np.random.default_rng(seed)) for seed in range(400)])
    assert np.array_equal(draws, again)
    assert np.ptp(draws, axis=0).min() > 0.1
    # tanh is monotonic, so the median of the actions is the action of the median.
    assert np.median(draws, axis=0) == pytest.approx(
        mode.act(observations[0], np.random.default_rng(0)), abs=0.25
    )


def test_a_random_policy_fills_the_action_space() -> None:
    policy, rng = RandomPolicy(3), np.random.default_rng(0)
    actions = np.array([policy.act(np.zeros(11), rng) for _ in range(2000)])
    assert actions.dtype == np.float32
    assert np.abs(actions).max() <= 1.0
    assert actions.mean(axis=0) == pytest.approx(np.zeros(3), abs=0.06)
    assert actions.var(axis=0) == pytest.approx(np.full(3, 1 / 3), abs=0.03)
    assert make(HOPPER).action_space.contains(actions[0])


def test_a_policy_of_another_robot_is_refused_with_the_robot_that_it_fits(tmp_path: Path) -> None:
    path = tmp_path / "walker.safetensors"
    save_file(dict(random_actor(17, 6).weights), path)
    with pytest.raises(
        PolicyError,
        match="maps 17 observations to 6 actions, but hopper has 11 and 3; it fits halfcheetah and walker2d",
    ):
        load_policy(HOPPER, path=path)
    assert isinstance(load_policy("walker2d-base", path=path), Actor)


def test_broken_and_foreign_files_are_named(tmp_path: Path) -> None:
    good = export_zip(HOPPER, tmp_path / "good.zip", random_actor())
    cases = {
        "text.zip": (b"no zip at all", "is no policy"),
        "cut.zip": (good.read_bytes()[:5000], "cannot be read as a policy: it is damaged"),
        "text.safetensors": (b"nor this", "holds no actor"),
    }
    for name, (data, message) in cases.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(PolicyError, match=message):
            read_actor(tmp_path / name)
    foreign = tmp_path / "foreign.zip"
    with zipfile.ZipFile(foreign, "w") as archive:
        archive.writestr("README", "hello")
    with pytest.raises(PolicyError, match="it has no entry data"):
        read_actor(foreign)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mu.weight": np.zeros((3, 7), np.float32)}, "mu: takes 7 inputs"),
        ({"mu.bias": np.zeros(4, np.float32)}, "mu: weight .* are no layer"),
        (
            {"log_std.weight": np.zeros((2, 256), np.float32), "log_std.bias": np.zeros(2, np.float32)},
            "3 means but 2",
        ),
        ({"mu.bias": np.array([0, np.nan, 0], np.float32)}, "not finite"),
        ({"extra.weight": np.zeros((1, 1), np.float32)}, "'extra.weight' is unexpected"),
    ],
)
def test_weights_that_make_no_actor_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(PolicyError, match=message):
        Actor(dict(random_actor().weights) | change)


def test_the_digest_is_of_all_that_decides_actions() -> None:
    actor = random_actor()
    bias = actor.weights["mu.bias"].copy()
    bias[0] = np.nextafter(bias[0], np.float32(1))
    changed = Actor(dict(actor.weights) | {"mu.bias": bias})
    assert random_actor().sha256 == actor.sha256
    assert len({actor.sha256, changed.sha256, random_actor(activation="Tanh").sha256}) == 3


def test_an_actor_is_shown_in_one_line() -> None:
    actor = random_actor(widths=(32, 16), algorithm="CrossQ", deterministic=False)
    assert str(actor) == repr(actor) == "Actor(CrossQ, layers 11-32-16-3, ReLU, stochastic)"


def test_a_layer_that_is_too_wide_is_refused() -> None:
    assert random_actor(widths=(8192, 4)).act(np.zeros(11), np.random.default_rng(0)).shape == (3,)
    with pytest.raises(PolicyError, match=r"latent_pi\.2: takes 8193 inputs; the limit is 8192"):
        random_actor(widths=(8193, 4))
