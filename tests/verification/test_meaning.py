"""`verify` finds a changed meaning: the values are consistent, and all digests are right."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.publishing.publisher import publish, publish_recipe
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.storage import file_format
from imujoco_minari.storage.metadata import complete_metadata, read_metadata
from imujoco_minari.variants import Variant
from imujoco_minari.verification import verify

BASE, LEG = "imujoco/hopper-base-random-v0", "imujoco/hopper-massdec_25_leggeom-random-v0"
RANKED, BOTH = "imujoco/hopper-base-ranked-v0", "imujoco/hopper-both-v0"
OTHER = Variant.parse("hopper-massdec_25_leggeom")

pytestmark = pytest.mark.usefixtures("checked_here")


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Minari root with sound datasets of one policy and of several, and a collection."""
    root = tmp_path_factory.mktemp("published")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        for variant in ("hopper-base", "hopper-massdec_25_leggeom"):
            publish(variant, tier="random", episodes=3)
        publish("hopper-base", tier="ranked", episodes=5)
        publish("hopper-massdec_25_leggeom", episodes=1)
        publish_recipe(Recipe(Variant("hopper"), tier="medium", stochastic=True, episodes=1))
        combine_datasets([BASE, LEG], BOTH)
    return root


class Dataset:
    """A dataset that a test changes: its metadata, and its open file."""

    def __init__(self, data: Path, file: h5py.File) -> None:
        self.metadata = read_metadata(data)
        self.file = file
        self.episodes = [file[f"episode_{number}"] for number in range(len(file))]

    def set(self, **values: Any) -> None:
        self.metadata |= values

    def label(self, **values: Any) -> None:
        """Set attributes of the file, of every episode and of the metadata."""
        self.set(**values)
        for group in (self.file, *self.episodes):
            group.attrs.update(values)

    def put(self, number: int, key: str, values: Any) -> None:
        del self.episodes[number][key]
        self.episodes[number][key] = values

    def cast(self, key: str, dtype: str) -> None:
        for number, episode in enumerate(self.episodes):
            self.put(number, key, episode[key][()].astype(dtype))

    def arrange(self, *numbers: int) -> None:
        """Let the file hold copies of the numbered episodes, in this order."""
        for place, number in enumerate(numbers):
            self.file.copy(f"episode_{number}", f"new_{place}")
        for name in [name for name in self.file if name.startswith("episode_")]:
            del self.file[name]
        for place in range(len(numbers)):
            self.file.move(f"new_{place}", f"episode_{place}")
            self.file[f"episode_{place}"].attrs["id"] = place
        self.episodes = [self.file[f"episode_{place}"] for place in range(len(numbers))]
        steps = sum(int(episode.attrs["total_steps"]) for episode in self.episodes)
        returns = [float(episode.attrs["rewards_sum"]) for episode in self.episodes]
        self.set(total_episodes=len(numbers), total_steps=steps, **file_format.return_statistics(returns))

    def spec(self, **values: Any) -> str:
        return json.dumps(json.loads(self.metadata["env_spec"]) | values)

    def unreplayed(self) -> None:
        self.label(replayable=False)
        for number, episode in enumerate(self.episodes):
            self.put(number, "observations", np.zeros_like(episode["observations"][()]))
            del episode.attrs["seed"]


def reseal(data: Path, dataset: Dataset) -> None:
    for episode in dataset.episodes:
        file_format.seal_episode(episode)
    digest = file_format.content_sha256(dataset.file, len(dataset.episodes))
    dataset.file.attrs["content_sha256"] = digest
    dataset.set(content_sha256=digest)
    kept = {key: value for key, value in dataset.metadata.items() if value is not ...}
    (data / "metadata.json").write_text(json.dumps(kept))


def relabelled(dataset: Dataset) -> None:
    dataset.label(**file_format.attributes(OTHER, "random"), catalogue="imujoco-original")


def evaluation(dataset: Dataset, kind: str, score: float) -> None:
    changed = dataset.metadata[f"ref_{kind}_evaluation"] | {"return_mean": score}
    dataset.set(**{f"ref_{kind}_score": score, f"ref_{kind}_evaluation": changed})


def as_imported(dataset: Dataset) -> None:
    dataset.unreplayed()
    dataset.set(combined_datasets=[])


def swap_ranks(dataset: Dataset) -> None:
    for key in ("rank", "policy_return"):
        one, other = dataset.episodes[0].attrs[key], dataset.episodes[1].attrs[key]
        dataset.episodes[0].attrs[key], dataset.episodes[1].attrs[key] = other, one


def versions(dataset: Dataset, **changed: str) -> dict[str, str]:
    return dict(dataset.metadata["versions"], **changed)


EXPERT, SAMPLED = "imujoco/hopper-massdec_25_leggeom-v0", "imujoco/hopper-base-medium-v0"
BOX = {"type": "Box", "dtype": "float32", "shape": [3], "low": [-2.0] * 3, "high": [2.0] * 3}
CHANGES: dict[str, tuple[str, Callable[[Dataset], Any], str]] = {
    "id of another variant": (BASE, lambda d: d.set(dataset_id=LEG), "dataset_id"),
    "id of another tier": (BASE, lambda d: d.set(dataset_id="imujoco/hopper-base-v0"), "dataset_id"),
    "id of nothing": (BASE, lambda d: d.set(dataset_id="imujoco/best-v0"), "dataset_id"),
    "another tier": (BASE, lambda d: d.label(tier="expert"), "dataset_id"),
    "imported, zero, no collection": (BASE, as_imported, "combined_datasets"),
    "imported, zero": (BASE, Dataset.unreplayed, "metadata.json/source"),
    "imported with seeds": (BASE, lambda d: d.label(replayable=False, source="x"), "@seed"),
    "replayable is 0": (BASE, lambda d: d.label(replayable=0), "replayable"),
    "an empty collection": (BASE, lambda d: d.set(combined_datasets=[]), "combined_datasets"),
    "a collection under a variant's id": (
        BOTH,
        lambda d: d.set(dataset_id=BASE),
        "metadata.json/dataset_id",
    ),
    "a collection's variant": (BOTH, lambda d: d.set(variant="hopper-base"), "metadata.json/variant"),
    "a collection's episode from elsewhere": (
        BOTH,
        lambda d: d.episodes[0].attrs.update(source="imujoco/hopper-base-v0"),
        "@source",
    ),
    "base episodes as an original": (BASE, relabelled, "metadata.json/dataset_id"),
    "half observations": (BASE, lambda d: d.cast("observations", "f2"), "observations"),
    "single rewards": (BASE, lambda d: d.cast("rewards", "f4"), "rewards"),
    "double actions": (BASE, lambda d: d.cast("actions", "f8"), "actions"),
    "big-endian observations": (BASE, lambda d: d.cast("observations", ">f8"), "observations"),
    "an array of its own": (
        BASE,
        lambda d: d.file.create_dataset("episode_0/infos/x", data=[1.0]),
        "episode_0/infos",
    ),
    "an episode twice": (BASE, lambda d: d.arrange(0, 0, 1), "episode_1@seed"),
    "an episode fewer": (BASE, lambda d: d.arrange(0, 2), "episode_1@seed"),
    "the first episode missing": (BASE, lambda d: d.arrange(1, 2), "episode_0@seed"),
    "episodes swapped": (BASE, lambda d: d.arrange(1, 0, 2), "episode_0@seed"),
    "another base seed": (BASE, lambda d: d.set(seed=1), "@seed"),
    "no base seed": (BASE, lambda d: d.set(seed=...), "metadata.json/seed"),
    "another return": (BASE, lambda d: d.set(return_mean=1e4), "metadata.json/return_mean"),
    "an expert's reference": (EXPERT, lambda d: evaluation(d, "max", 1.0), "ref_max_score"),
    "a random reference": (EXPERT, lambda d: evaluation(d, "min", -1e6), "ref_min_score"),
    "a score without its evaluation": (BASE, lambda d: d.set(ref_max_score=1.0), "ref_max_score"),
    "no digest of a policy": (BASE, lambda d: d.set(policy_sha256="me"), "policy_sha256"),
    "no policy": (BASE, lambda d: d.set(policy_sha256=...), "policy_sha256"),
    "another algorithm": (BASE, lambda d: d.set(algorithm_name="SAC"), "algorithm_name"),
    "a deterministic random policy": (
        BASE,
        lambda d: d.set(policy_deterministic=True),
        "policy_deterministic",
    ),
    "modes as samples": (EXPERT, lambda d: d.set(policy_deterministic=False), "episode_0/actions"),
    "samples as modes": (SAMPLED, lambda d: d.set(policy_deterministic=True), "episode_0/actions"),
    "ranks swapped": (RANKED, swap_ranks, "episode_0@"),
    "other versions": (BASE, lambda d: d.set(versions=versions(d, mujoco="3.0.0")), "requirements"),
    "no versions": (BASE, lambda d: d.set(versions=...), "versions"),
    "a version of Minari to come": (
        BASE,
        lambda d: d.set(minari_version="9.9.9", versions=versions(d, minari="9.9.9")),
        "minari_version",
    ),
    "an author 5": (BASE, lambda d: d.set(author=5), "metadata.json/author"),
    "requirements of no list": (BASE, lambda d: d.set(requirements="mujoco"), "metadata.json/requirements"),
    "another action space": (BASE, lambda d: d.set(action_space=json.dumps(BOX)), "action_space"),
    "a model for the evaluation": (
        BASE,
        lambda d: d.set(eval_env_spec=d.spec(kwargs={"variant": "hopper-base", "mjcf": "/etc/passwd"})),
        "eval_env_spec",
    ),
    "another id of the environment": (BASE, lambda d: d.set(env_spec=d.spec(id="Hopper-v5")), "env_spec"),
    "another threshold": (BASE, lambda d: d.set(env_spec=d.spec(reward_threshold=1.0)), "env_spec"),
}


@pytest.mark.parametrize("kind", list(CHANGES))
def test_a_changed_meaning_is_found(published: Path, root: Path, kind: str) -> None:
    name, change, where = CHANGES[kind]
    shutil.copytree(published, root)
    assert verify(name) == []
    data = root / name / "data"
    with h5py.File(file_format.main_file(data), "a") as file:
        dataset = Dataset(data, file)
        change(dataset)
        reseal(data, dataset)
    complete_metadata(data, {})
    place = str(read_metadata(data)["dataset_id"])
    if place != name:
        # The id and the place agree.
        shutil.rmtree(root / place, ignore_errors=True)
        (root / name).rename(root / place)
    findings = verify(place)
    assert any(where in finding.where for finding in findings), findings


def test_an_honest_dataset_has_no_exception(published: Path, root: Path) -> None:
    shutil.copytree(published, root)
    for name in (BASE, LEG, EXPERT, SAMPLED, RANKED, BOTH):
        findings = verify(name)
        assert (findings, findings.exceptions) == ([], ())


def test_an_unknown_policy_is_an_exception(published: Path, root: Path) -> None:
    shutil.copytree(published, root)
    data = root / EXPERT / "data"
    complete_metadata(data, {"policy_sha256": "0" * 64})
    findings = verify(EXPERT)
    assert findings == []
    assert findings.exceptions == ("the policy that made it is not known here",)
    evaluation = read_metadata(data)["ref_max_evaluation"] | {"return_mean": 1.0}
    complete_metadata(data, {"ref_max_score": 1.0, "ref_max_evaluation": evaluation})
    assert verify(EXPERT).exceptions[-1] == "its reference scores are not known here"


def test_a_training_run_is_an_exception(published: Path, root: Path) -> None:
    shutil.copytree(published, root)
    name = "imujoco/hopper-base-replay-v0"
    (root / BASE).rename(root / name)
    data = root / name / "data"
    with h5py.File(file_format.main_file(data), "a") as file:
        dataset = Dataset(data, file)
        dataset.label(tier="replay")
        for episode in dataset.episodes:
            episode.attrs["source"] = name
        dataset.arrange(2, 1)
        dataset.set(dataset_id=name, policy_sha256=...)
        reseal(data, dataset)
    complete_metadata(data, {})
    findings = verify(name)
    assert findings == []
    assert findings.exceptions == ("it records a training run, whose seeds are its own",)
