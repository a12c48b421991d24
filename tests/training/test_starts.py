"""The start of a variant's training: folded actor and critics, or the base's agent where it scores higher."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from imujoco_minari.errors import PolicyNotFoundError
from imujoco_minari.policies import Array, agent_file, expert_record, universal_policy
from imujoco_minari.policies.evaluation import Evaluation
from imujoco_minari.policies.experts import FOLDED
from imujoco_minari.training import starts
from imujoco_minari.training.agents import CRITICS, actor_of, agent_actor, load_arrays
from imujoco_minari.training.critics import fold_critics, with_context
from imujoco_minari.training.starts import best_start
from imujoco_minari.variants import Variant, specification

VARIANT = Variant.parse("hopper-massinc_37_torsogeom-jointdec_20_legjoint")
LAYERS = ("BatchRenorm_0", "Dense_0", "BatchRenorm_1", "Dense_1", "BatchRenorm_2", "Dense_2")


def critic(arrays: dict[str, Array], x: Array) -> Array:
    """The first critic written out in float64, with its running statistics."""
    for name in LAYERS:
        layer = {
            key.rpartition("/")[2]: np.float64(array[0])
            for key, array in arrays.items()
            if f"VmapCritic_0/{name}/" in key and key.startswith(("qf/params", "qf/batch_stats"))
        }
        if "kernel" in layer:
            x = x @ layer["kernel"] + layer["bias"]
            x = np.maximum(x, 0) if name != "Dense_2" else x
        else:
            x = (x - layer["mean"]) / np.sqrt(layer["var"] + 1e-3) * layer["scale"] + layer["bias"]
    return x


def told_critics(rng: np.random.Generator) -> dict[str, Array]:
    """Critics of Hopper that are told the context: the base's, with random weights for the context."""
    path, universal = agent_file(Variant("hopper")), universal_policy("hopper")
    assert path is not None
    assert universal is not None
    base, count = load_arrays(path), len(universal.low)
    arrays = with_context(base, rng.normal(size=(9, count)).astype(np.float32), "hopper")
    return {
        name: array + rng.normal(size=array.shape).astype(np.float32) * 0.1
        if name.startswith(("qf/params", "qf/batch_stats")) and not name.endswith(("var", "steps", "max"))
        else array
        for name, array in arrays.items()
    }


def test_folded_critics_judge_as_those_that_are_told() -> None:
    rng, universal = np.random.default_rng(0), universal_policy("hopper")
    assert universal is not None
    arrays = told_critics(rng)
    folded = fold_critics("hopper", universal.context(VARIANT), arrays)
    seen, actions = rng.normal(size=(20, 11)), rng.uniform(-1, 1, size=(20, 3))
    told = np.tile(universal.context(VARIANT), (20, 1))
    whole = critic(arrays, np.concatenate([seen, told, actions], axis=1))
    assert critic(folded, np.concatenate([seen, actions], axis=1)) == pytest.approx(whole, rel=1e-4, abs=1e-3)
    base = load_arrays(agent_file(Variant("hopper")) or Path())
    assert {name: array.shape for name, array in folded.items()} == {
        name: array.shape for name, array in base.items() if name.startswith(CRITICS)
    }


@pytest.mark.parametrize(("value", "found"), [(50.0, FOLDED), (30.0, "hopper-base")])
def test_the_better_one_is_the_start(value: float, found: str, monkeypatch: pytest.MonkeyPatch) -> None:
    universal = universal_policy("hopper")
    assert universal is not None
    folded = universal.fold(VARIANT).sha256

    def evaluate(env: object, actor: object, *, episodes: int, seed: int) -> Evaluation:
        weights = actor.weights  # type: ignore[attr-defined]
        is_folded = np.allclose(
            weights["latent_pi.0.bias"], universal.fold(VARIANT).weights["latent_pi.0.bias"], atol=1e-2
        )
        return Evaluation(np.full(episodes, value if is_folded else 40.0), np.ones(episodes), (), seed, True)

    monkeypatch.setattr(starts, "evaluate", evaluate)
    start = best_start(VARIANT, Path("nowhere"), 0)
    assert (start.name, start.score) == (found, max(value, 40.0))
    if found == FOLDED:
        assert start.sha256 == expert_record(VARIANT)["universal_sha256"]
        assert folded == expert_record(VARIANT)["weights_sha256"]
    else:
        assert start.sha256 == expert_record(Variant("hopper"))["weights_sha256"]
    actor = actor_of(agent_actor(start.agent), "hopper")
    assert actor.observation_size == specification("hopper").observation_size


def test_a_robot_without_a_universal_policy_starts_from_its_base(unshipped: None, tmp_path: Path) -> None:
    with pytest.raises(PolicyNotFoundError, match="`imujoco train hopper-base` first"):
        best_start(VARIANT, tmp_path, 0)
