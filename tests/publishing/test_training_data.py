"""A training run is published as a dataset: whole episodes, up to the end that its tier asks for."""

from __future__ import annotations

import json
from pathlib import Path

import minari
import pytest
from tiny_training import TINY

from imujoco_minari.cli.app import run
from imujoco_minari.errors import DatasetError, DatasetExistsError, PolicyNotFoundError, TrainingError
from imujoco_minari.policies import expert_record, policies_folder
from imujoco_minari.publishing import training_data
from imujoco_minari.publishing.publisher import publish, publish_recipe
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.publishing.training_data import record_training
from imujoco_minari.training.hyperparameters import SCRATCH, Hyperparameters, hyperparameters
from imujoco_minari.training.task import Task
from imujoco_minari.variants import Ranges, Variant
from imujoco_minari.verification import verify

LIGHT_LEG = Variant.parse("hopper-massdec_25_leggeom")

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.usefixtures("checked_here"),
]


def expect(value: float) -> None:
    """Give the light leg an expert of this return."""
    record = dict(expert_record(LIGHT_LEG))
    record["evaluation"] = record["evaluation"] | {"return_mean": value}
    policies_folder().mkdir(parents=True, exist_ok=True)
    (policies_folder() / f"{LIGHT_LEG}.json").write_text(json.dumps(record))


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    def few(robot: str, start: str) -> Hyperparameters:
        return hyperparameters(robot, start, **TINY)

    monkeypatch.setattr(training_data, "hyperparameters", few)


def test_a_recorded_run_publishes_its_whole_episodes(tmp_path: Path) -> None:
    task = Task(LIGHT_LEG, hyperparameters("hopper", SCRATCH, **TINY))
    published = record_training(task, tmp_path / "run")
    dataset = minari.load_dataset(published.dataset_id)
    assert published.dataset_id == "imujoco/hopper-massdec_25_leggeom-replay-v0"
    # Three of four intervals cut an episode short; none of those is there.
    assert dataset.total_episodes > 5
    assert all(episode.terminations[-1] or episode.truncations[-1] for episode in dataset)
    assert 200 < dataset.total_steps < 400
    assert verify(published.dataset_id) == []
    assert not (tmp_path / "run").exists()
    # What is published is not trained again, and another seed is another dataset.
    assert not record_training(task, tmp_path / "run").created
    with pytest.raises(DatasetExistsError, match="it has seed 0; you asked for seed 1"):
        record_training(Task(LIGHT_LEG, task.settings, seed=1), tmp_path / "run")


@pytest.mark.usefixtures("tiny")
def test_medium_replay_ends_at_the_medium_return_and_is_the_same_again() -> None:
    # Any actor reaches a return of 0, so the run ends at the first evaluation, after 250 of 350 steps.
    expect(0.0)
    counted: list[int] = []
    first = publish_recipe(Recipe(LIGHT_LEG, "medium-replay"), on_episode=lambda: counted.append(1))
    dataset = minari.load_dataset(first.dataset_id)
    assert first.dataset_id == "imujoco/hopper-massdec_25_leggeom-medium-replay-v0"
    assert 150 < dataset.total_steps <= 260
    assert len(counted) == dataset.total_episodes == first.episodes
    findings = verify(first.dataset_id)
    assert findings == []
    assert findings.exceptions == ("it records a training run, whose seeds are its own",)
    again = publish(LIGHT_LEG, tier="medium-replay", force=True)
    assert again.created
    assert again.content_sha256 == first.content_sha256
    other = publish(LIGHT_LEG, tier="medium-replay", seed=1, force=True)
    assert other.content_sha256 != first.content_sha256


@pytest.mark.usefixtures("tiny")
def test_a_run_that_does_not_reach_the_medium_return_is_not_published(root: Path) -> None:
    expect(1e5)
    with pytest.raises(TrainingError, match=r"has reached a return of \d+ in \d+ steps, not 42000"):
        publish(LIGHT_LEG, tier="medium-replay")
    assert not list(root.rglob("main_data.hdf5"))


def test_medium_replay_takes_a_seed_only(capsys: pytest.CaptureFixture[str]) -> None:
    base = Variant.parse("hopper-base")
    for options in ({"episodes": 20}, {"stochastic": True}, {"policy": Path("sac.zip")}):
        with pytest.raises(DatasetError, match="is a training run: it takes a seed, but no number of"):
            Recipe(base, "medium-replay", **options)  # type: ignore[arg-type]
    with pytest.raises(PolicyNotFoundError, match="humanoid-base has no expert"):
        publish("humanoid-base", tier="medium-replay")
    with pytest.raises(DatasetError, match="a training run on one variant, not on ranges"):
        publish(Ranges("hopper", {"mass/torsogeom": (-50, 50)}), tier="medium-replay")
    assert run(["publish", "hopper-base", "--tier", "medium-replay", "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("would publish imujoco/hopper-base-medium-replay-v0: a training run, about ")
