"""What people reach for first: names in tab completion, short prints, calls with few arguments."""

from __future__ import annotations

import copy
import pickle
import shutil
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

import gymnasium as gym
import minari
import numpy as np
import pytest

import imujoco_minari
from imujoco_minari import Sampler, arrays, combine_datasets, publish, randomised
from imujoco_minari.errors import DatasetError, StorageError, VariantError
from imujoco_minari.publishing import publisher
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.variants.ranges import drawing_ranges


def test_every_lazy_name_is_in_dir() -> None:
    lazy = [
        module
        for found in walk_packages(imujoco_minari.__path__, "imujoco_minari.")
        if found.ispkg and "__getattr__" in vars(module := import_module(found.name))
    ]
    assert {module.__name__ for module in lazy} == {"imujoco_minari.envs"}
    for module in (imujoco_minari, *lazy):
        assert set(module.__all__) <= set(dir(module))
        assert all(hasattr(module, name) for name in dir(module))
    assert {"publish", "load_policy", "arrays", "list_local_datasets"} <= set(dir(imujoco_minari))
    assert {"HopperVariantEnv", "CollectionEnv"} <= set(dir(lazy[0]))
    assert imujoco_minari.list_local_datasets is minari.list_local_datasets


@pytest.mark.parametrize("name", ["imujoco/hopper-mass-v0", "imujoco/hopper-randomised-v0"])
def test_an_environment_that_draws_shows_the_present_robot(name: str) -> None:
    env = gym.make(name).unwrapped
    variant = "hopper-massinc_50_torsogeom"
    env.reset(seed=0, options={"variant": variant})
    own = imujoco_minari.make(variant).unwrapped
    assert np.array_equal(env.model.body_mass, own.model.body_mass)  # type: ignore[attr-defined]
    assert env.dt == own.dt  # type: ignore[attr-defined]
    env.set_state(own.init_qpos, own.init_qvel)  # type: ignore[attr-defined]
    assert np.array_equal(env.data.qpos, own.init_qpos)  # type: ignore[attr-defined]
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        assert other.observation_space == env.observation_space
    with pytest.raises(AttributeError, match="no_such_thing"):
        _ = env.no_such_thing  # type: ignore[attr-defined]


def test_arrays_print_a_summary(small_datasets: list[str]) -> None:
    data = arrays(small_datasets, dtype="float32")
    assert repr(data).startswith("Arrays(3 variants of hopper, random: 16 episodes, ")
    assert f"{len(data)} transitions, float32, 0.0 MB" in repr(data)
    assert len(str(data)) < 150
    assert repr(arrays(small_datasets[0])).startswith("Arrays(hopper-base, random: 8 episodes")
    assert repr(Sampler(small_datasets[0])).startswith("Sampler(Arrays(hopper-base, random: 6 episodes")


def test_randomised_takes_the_catalogues_ranges() -> None:
    env = randomised("hopper")
    _, info = env.reset(seed=0)
    assert len(info["context"]) == len(drawing_ranges("hopper")) == 12
    assert drawing_ranges("hopper")["joint/legjoint"] == (-50, 0)
    for name, change in zip(drawing_ranges("hopper"), info["context"], strict=True):
        low, high = drawing_ranges("hopper")[name]
        assert low / 100 <= change <= high / 100


def test_several_variants_are_published_at_once(root: Path) -> None:
    ids = ["hopper-massdec_25_leggeom", "hopper-base"]
    outcomes = publish(iter(ids), tier="random", episodes=2, jobs=2)
    assert [outcome.dataset_id for outcome in outcomes] == [f"imujoco/{name}-random-v0" for name in ids]
    assert len(minari.list_local_datasets()) == 2
    with pytest.raises(VariantError, match="hopper-massdec_25_legeom"):
        publish(["hopper-base", "hopper-massdec_25_legeom"], tier="random", episodes=2)
    with pytest.raises(DatasetError, match="is already published, but differs"):
        publish(ids, tier="random", episodes=3)


def test_a_full_disk_is_noticed_before_any_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["hopper-base", "hopper-massdec_25_leggeom"]
    made = [publish(name, tier="random", episodes=3).dataset_id for name in names]
    sizes = [file_format.main_file(minari_root.dataset_folder(each) / "data").stat().st_size for each in made]
    free = shutil.disk_usage("/")._replace(free=40_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: free)
    assert min(sizes) < 40_000 < sum(sizes)
    assert publish("hopper-base", tier="random", episodes=3, force=True)
    with monkeypatch.context() as patch:
        patch.setattr(publisher, "record_shares", None)
        with pytest.raises(StorageError, match=r"hopper-base-v0: about 11\.\d MB needed, 0\.0 MB free"):
            publish("hopper-base")
    with pytest.raises(StorageError, match=r"me/two-v0: about 0\.\d MB needed"):
        combine_datasets(made, "me/two-v0")
    assert combine_datasets(made, "me/linked-v0", link=True).total_episodes == 6
    assert not minari_root.exists("me/two-v0")
