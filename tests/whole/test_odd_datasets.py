"""Datasets whose metadata or arrays are odd: every command ends with one line, never with a traceback."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from imujoco_minari.cli.app import run
from imujoco_minari.errors import DatasetError
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.storage import file_format
from imujoco_minari.variants import Variant

ODD, OTHER = "imujoco/hopper-base-random-v0", "imujoco/hopper-massdec_25_leggeom-random-v0"
COMMANDS = {
    "combine": ["combine", ODD, OTHER, "--id", "imujoco/hopper-new-v0"],
    "link": ["combine", ODD, OTHER, "--id", "imujoco/hopper-new-v0", "--link"],
    "verify": ["verify", ODD],
    "plot": ["plot", ODD, "-o", "plots"],
    "preferences": ["preferences", ODD, "-o", "pairs.npz", "--length", "3"],
    "render": ["render", ODD, "--episode", "1", "-o", "film.mp4"],
    "export": ["export", ODD, "-f", "npz", "-o", "data.npz"],
    "publish": ["publish", "hopper-base", "--tier", "random", "-n", "2"],
}


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Minari root with two small datasets, made once."""
    root = tmp_path_factory.mktemp("published")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        for variant in ("hopper-base", "hopper-massdec_25_leggeom"):
            publish(variant, tier="random", episodes=2)
    return root


def stated(**values: Any) -> Callable[[Path], None]:
    """Change the metadata."""

    def change(data: Path) -> None:
        path = data / "metadata.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | values))

    return change


def written(text: str) -> Callable[[Path], None]:
    """Replace the metadata file."""
    return lambda data: (data / "metadata.json").write_text(text) and None


def stored(change: Callable[[h5py.File], Any]) -> Callable[[Path], None]:
    """Change the HDF5 file."""

    def damage(data: Path) -> None:
        with h5py.File(file_format.main_file(data), "a") as file:
            change(file)

    return damage


def array(key: str, value: Any) -> Callable[[Path], None]:
    """Replace an array of the second episode; a function changes its values."""

    def change(file: h5py.File) -> None:
        new = value(file["episode_1"][key][()]) if callable(value) else value
        del file["episode_1"][key]
        file["episode_1"][key] = new

    return stored(change)


def cyclic(data: Path) -> None:
    stated(combined_datasets=[OTHER])(data)
    stated(combined_datasets=[ODD])(data.parents[2] / OTHER / "data")


def empty_group(file: h5py.File) -> None:
    del file["episode_1"]
    file.create_group("episode_1")


def rewards_as_group(file: h5py.File) -> None:
    del file["episode_1/rewards"]
    file["episode_1"].create_group("rewards")


def nan(values: Any) -> Any:
    return np.full_like(values, np.nan)


CASES: dict[str, tuple[Callable[[Path], None], str, str]] = {
    "metadata []": (written("[]"), "verify", "is no JSON object"),
    "metadata [], combined": (written("[]"), "combine", "does not state its observation_space"),
    "versions 7": (stated(versions=7), "verify", "metadata.json/versions is 7"),
    "an author 5": (stated(author=5), "combine", "its author is not a list of texts"),
    "requirements 5": (stated(requirements=5), "link", "its requirements is not a list of texts"),
    "too many episodes": (stated(total_episodes=10**20), "combine", "but its file holds 2"),
    "a negative number of episodes": (stated(total_episodes=-3), "link", "but its file holds 2"),
    "cyclic collections": (cyclic, "verify", "metadata.json has changed"),
    "an empty group": (stored(empty_group), "combine", "cannot be copied"),
    "an empty group, linked": (stored(empty_group), "link", ""),
    "an empty group, published": (stored(empty_group), "publish", "is not a complete dataset"),
    "no episode": (stored(h5py.File.clear), "publish", "it has no episodes"),
    "content that is a list": (
        stored(lambda file: file.attrs.__setitem__("content_sha256", [1, 2])),
        "combine",
        "was replaced while it was read",
    ),
    "NaN observations": (array("observations", nan), "plot", "its observations hold NaN or infinity"),
    "NaN actions": (array("actions", nan), "plot", "its actions hold NaN or infinity"),
    "NaN rewards": (array("rewards", nan), "preferences", "the rewards hold NaN or infinity"),
    "scalar rewards": (array("rewards", 1.0), "plot", "rewards are not an array"),
    "scalar rewards, exported": (array("rewards", 1.0), "export", "rewards are not an array"),
    "scalar rewards, verified": (array("rewards", 1.0), "verify", "has no steps"),
    "scalar rewards, drawn": (array("rewards", 1.0), "render", "its rewards have shape ()"),
    "scalar observations": (array("observations", 1.0), "render", "its observations have shape ()"),
    "few observations": (array("observations", lambda v: v[:1]), "render", "have shape (1, 11)"),
    "empty observations": (array("observations", h5py.Empty("f8")), "render", "cannot be read"),
    "a negative seed": (
        stored(lambda file: file["episode_1"].attrs.__setitem__("seed", -5)),
        "render",
        "its seed is -5",
    ),
    "a seed that is no number": (
        stored(lambda file: file["episode_1"].attrs.__setitem__("seed", "x")),
        "render",
        "cannot be read",
    ),
    "a group of rewards": (stored(rewards_as_group), "render", "cannot be read"),
}


@pytest.mark.usefixtures("checked_here")
@pytest.mark.parametrize("case", list(CASES))
def test_one_line(
    case: str,
    published: Path,
    root: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    change, command, message = CASES[case]
    shutil.copytree(published, root)
    monkeypatch.chdir(tmp_path)
    change(root / ODD / "data")
    code = run(COMMANDS[command])
    shown = capsys.readouterr()
    if not message:
        assert code == 0
        return
    assert code in (1, 2)
    assert message in " ".join((shown.out + shown.err).split())
    assert "Traceback" not in shown.err


def test_a_mistyped_number_of_episodes(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["publish", "hopper-base", "--tier", "random", "-n", "99999999999999"]) == 2
    assert "should be less than or equal to 1000000" in capsys.readouterr().err
    with pytest.raises(DatasetError, match="a dataset has 1 to 1000000 episodes"):
        Recipe(Variant.parse("hopper-base"), episodes=99999999999999)
