"""Every test has a Minari root of its own, and none needs the network."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from imujoco_minari.policies import policies_folder

# How long an example takes says nothing on a busy machine.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


@pytest.fixture(autouse=True)
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The Minari root of the test: an empty folder that does not exist yet."""
    path = tmp_path / "minari"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(path))
    monkeypatch.delenv("MINARI_REMOTE", raising=False)
    return path


@pytest.fixture(autouse=True, scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Let the training tests compile each of JAX's programs once, in one of the workers."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", str(shared / "compiled"))
        patch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        # With a limit, JAX locks the folder.
        patch.setenv("JAX_COMPILATION_CACHE_MAX_SIZE", str(2**30))
        yield


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The test's own folder for policies and training, instead of the user's."""
    path = tmp_path / "imujoco"
    monkeypatch.setenv("IMUJOCO_HOME", str(path))
    return path


# Random Hoppers fall within some twenty steps, so these are made in a second.
SMALL_DATASETS = {
    "imujoco/hopper-base-random-v0": 8,
    "imujoco/hopper-massdec_25_leggeom-random-v0": 4,
    "imujoco/hopper-frictiondec_50_feet-random-v0": 4,
}


@pytest.fixture(scope="session")
def _small_datasets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from imujoco_minari.publishing.publisher import publish
    from imujoco_minari.variants import parse_dataset_id

    path = tmp_path_factory.mktemp("small")
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("MINARI_DATASETS_PATH", str(path))
        for dataset_id, episodes in SMALL_DATASETS.items():
            variant, tier = parse_dataset_id(dataset_id)
            publish(variant, tier=tier, episodes=episodes)
    return path


@pytest.fixture
def small_datasets(root: Path, _small_datasets: Path) -> list[str]:
    """Ids of three datasets in the test's root: 8, 4 and 4 episodes of random Hoppers, all terminated."""
    shutil.copytree(_small_datasets, root)
    return list(SMALL_DATASETS)


@pytest.fixture
def unshipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide the policies that the package ships: more of them land with every release."""
    monkeypatch.setattr(
        "imujoco_minari.policies.experts._places", lambda folder: (folder or policies_folder(),)
    )


@pytest.fixture
def checked_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Check datasets in this process: a child takes a second to start, and the verification tests it."""
    from imujoco_minari.verification import child_process
    from imujoco_minari.verification.check import check

    monkeypatch.setattr(child_process, "check_apart", lambda data, metadata, jobs=1: check(data, metadata))


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read policy zips in this process: a child takes two seconds to import torch."""
    from imujoco_minari.policies import files
    from imujoco_minari.policies.sb3_reader import read_zip

    monkeypatch.setattr(files, "run_limited", lambda function, argument, **limits: read_zip(argument))
