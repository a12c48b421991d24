"""The start of a variant's training: folded actor and critics, or the base's agent where it scores higher."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from imujoco_minari.errors import PolicyNotFoundError
from imujoco_minari.policies import Actor, Array, agent_file, expert_record, universal_policy
from imujoco_minari.policies.evaluation import Evaluation
from imujoco_minari.policies.experts import FOLDED
from imujoco_minari.training import starts
from imujoco_minari.training.agents import CRITICS, actor_of, agent_actor, load_arrays
from imujoco_minari.training.context_search import SEARCHED
from imujoco_minari.training.critics import fold_critics, with_context
from imujoco_minari.training.starts import best_start
from imujoco_minari.variants import Variant

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


@pytest.mark.parametrize(
    ("best", "name", "told"),
    [("folded", FOLDED, str(VARIANT)), ("searched", FOLDED, SEARCHED), ("base", "hopper-base", "")],
)
def test_the_best_one_is_the_start(best: str, name: str, told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    universal, path = universal_policy("hopper"), agent_file(Variant("hopper"))
    assert universal is not None
    assert path is not None
    own = universal.context(VARIANT)
    biases = {
        "folded": universal.fold(VARIANT).weights["latent_pi.0.bias"],
        "searched": universal.fold_context(own + 0.01).weights["latent_pi.0.bias"],
        "base": agent_actor(load_arrays(path))["latent_pi.0.bias"],
    }

    def evaluate(env: object, actor: Actor, *, episodes: int, seed: int) -> Evaluation:
        is_best = np.array_equal(actor.weights["latent_pi.0.bias"], biases[best].astype(np.float16))
        return Evaluation(np.full(episodes, 50.0 if is_best else 40.0), np.ones(episodes), (), seed, True)

    monkeypatch.setattr(starts, "search_contexts", lambda *_: [own + 0.01])
    monkeypatch.setattr(starts, "evaluate", evaluate)
    start = best_start(VARIANT, Path("nowhere"), 1)
    assert (start.name, start.told, start.score) == (name, told, 50.0)
    of_base, of_folded = expert_record(Variant("hopper")), expert_record(VARIANT)
    assert start.sha256 == (of_base["weights_sha256"] if best == "base" else of_folded["universal_sha256"])
    assert actor_of(agent_actor(start.agent), "hopper").observation_size == 11


def test_a_robot_without_a_universal_policy_starts_from_its_base(unshipped: None, tmp_path: Path) -> None:
    with pytest.raises(PolicyNotFoundError, match="`imujoco train hopper-base` first"):
        best_start(VARIANT, tmp_path, 0)
