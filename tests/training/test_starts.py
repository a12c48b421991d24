"""The start of a variant's training. Each actor here scores what its bias says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from imujoco_minari.policies import Actor, Array
from imujoco_minari.policies.evaluation import Evaluation
from imujoco_minari.training import starts
from imujoco_minari.training.agents import agent_actor, save_arrays
from imujoco_minari.training.starts import best_start
from imujoco_minari.variants import Variant

VARIANT = Variant.parse("hopper-massinc_37_torsogeom")
LAYERS = {"Dense_0": (11, 4), "Dense_1": (4, 4), "Dense_2": (4, 3), "Dense_3": (4, 3)}


def agent(value: float, width: int = 4) -> dict[str, Array]:
    arrays: dict[str, Array] = {"qf/params/kernel": np.full((2, 2), value)}
    for name, shape in LAYERS.items():
        sizes = tuple(width if size == 4 else size for size in shape)
        arrays[f"actor/params/{name}/kernel"] = np.full(sizes, value, np.float32)
        arrays[f"actor/params/{name}/bias"] = np.full(sizes[1], value, np.float32)
    return arrays


def write_expert(folder: Path, name: str, value: float, width: int = 4) -> None:
    save_arrays(folder / f"{name}.safetensors", agent_actor(agent(value, width)))
    (folder / f"{name}.json").write_text(
        json.dumps({"weights_sha256": f"digest of {name}", "evaluation": {"return_mean": 100.0}})
    )


@pytest.fixture
def policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unshipped: None) -> Path:
    """A folder with a base whose agent scores 40, and a generalist that scores 50."""

    def evaluate(env: object, actor: Actor, *, episodes: int, seed: int) -> Evaluation:
        value = float(actor.weights["mu.bias"][0])
        # This one is lucky in its first episode.
        value = 20.0 if value == 99.0 and episodes > 1 else value
        return Evaluation(np.full(episodes, value), np.ones(episodes), ("",) * episodes, seed, True)

    monkeypatch.setattr(starts, "evaluate", evaluate)
    write_expert(tmp_path, "hopper-base", 40.0)
    save_arrays(tmp_path / "hopper-base.agent.safetensors", agent(40.0))
    save_arrays(tmp_path / "hopper-all.agent.safetensors", agent(50.0))
    (tmp_path / "hopper-all.agent.json").write_text('{"weights_sha256": "digest of hopper-all"}')
    return tmp_path


LIGHT, LIGHTER = "hopper-massdec_25_leggeom", "hopper-massdec_50_leggeom"


@pytest.mark.parametrize(
    ("experts", "target_share", "found"),
    [
        ({}, 0.9, "hopper-all"),
        # The agent has critics, so a somewhat better expert does not replace it.
        ({LIGHT: 60.0}, 0.9, "hopper-all"),
        ({LIGHT: 70.0}, 0.9, LIGHT),
        ({LIGHT: 56.0}, 0.55, LIGHT),
        # The agent reaches the target.
        ({LIGHT: 70.0}, 0.45, "hopper-all"),
        ({LIGHT: 70.0, LIGHTER: 99.0}, 0.9, LIGHT),
        # Neither its own expert nor another robot's is tried.
        ({str(VARIANT): 80.0, "walker2d-massdec_25_leggeom": 80.0}, 0.9, "hopper-all"),
    ],
)
def test_an_expert_of_another_variant_is_the_start_if_it_is_far_better(
    experts: dict[str, float], target_share: float, found: str, policies: Path
) -> None:
    for name, value in experts.items():
        write_expert(policies, name, value)
    start = best_start(VARIANT, policies, target_share)
    assert start.name == found
    assert start.sha256 == f"digest of {found}"
    value = experts.get(found, 50.0)
    assert start.score == value
    assert {name: array.tolist() for name, array in agent_actor(start.agent).items()} == {
        name: array.tolist() for name, array in agent_actor(agent(value)).items()
    }
    # The critics are the agent's.
    assert start.agent["qf/params/kernel"].tolist() == agent(50.0)["qf/params/kernel"].tolist()


def test_an_expert_of_another_shape_is_no_start(policies: Path) -> None:
    write_expert(policies, LIGHT, 80.0, width=8)
    assert best_start(VARIANT, policies, 0.9).name == "hopper-all"
