"""load_dataset: one call, whether the dataset is published or not."""

from __future__ import annotations

from pathlib import Path

import pytest

from imujoco_minari import load_dataset, publish
from imujoco_minari.errors import DatasetIdError, DatasetNotFoundError, PolicyNotFoundError
from imujoco_minari.publishing import on_demand
from imujoco_minari.storage import minari_root

FEET = [f"imujoco/hopper-friction{change}_feet-random-v0" for change in ("dec_50", "dec_25", "inc_50")]


def test_a_missing_dataset_is_published_once(capsys: pytest.CaptureFixture[str], root: Path) -> None:
    first = load_dataset(FEET[0])
    assert capsys.readouterr().err == f"{FEET[0]} is not in the Minari root: publishing 100 episodes\n"
    assert first.total_episodes == 100
    # What publish() calls the same recipe, and leaves alone.
    assert not publish("hopper-frictiondec_50_feet", tier="random").created
    before = minari_root.folder_identity(root / FEET[0])
    assert load_dataset(FEET[0]).spec == first.spec
    assert minari_root.folder_identity(root / FEET[0]) == before
    assert capsys.readouterr().err == ""


def test_a_missing_collection_is_made_of_what_is_there_and_what_is_not(
    capsys: pytest.CaptureFixture[str], root: Path
) -> None:
    publish("hopper-frictiondec_50_feet", tier="random", episodes=2, seed=7)
    before = minari_root.folder_identity(root / FEET[0])
    collection = load_dataset("imujoco/hopper-friction-random-v0", quiet=True)
    assert capsys.readouterr().err == ""
    assert collection.storage.metadata["combined_datasets"] == FEET
    assert collection.total_episodes == 202
    assert minari_root.folder_identity(root / FEET[0]) == before
    assert load_dataset(FEET[2]).total_episodes == 100


@pytest.mark.parametrize(
    ("dataset_id", "error", "message"),
    [
        ("imujoco/hopper-base-replay-v0", DatasetNotFoundError, "imujoco train hopper-base --record-replay"),
        ("imujoco/hopper-base-v1", DatasetNotFoundError, "is not in the Minari root"),
        ("imujoco/hopper-mine-v0", DatasetNotFoundError, "minari list local"),
        ("D4RL/door/human-v2", DatasetNotFoundError, "minari list local"),
        ("imujoco/hopper-base-best-v0", PolicyNotFoundError, "no policy makes the tier 'best'"),
        ("imujoco/humanoid-base-v0", PolicyNotFoundError, "imujoco train"),
        ("hopper-base", DatasetIdError, "malformed dataset id"),
        (None, DatasetIdError, "malformed dataset id"),
    ],
)
def test_what_cannot_be_made_is_named(
    dataset_id: str, error: type[Exception], message: str, root: Path
) -> None:
    with pytest.raises(error, match=message) as raised:
        load_dataset(dataset_id)
    assert "\n" not in str(raised.value)
    assert not (root / "imujoco").exists()


def test_a_collection_of_which_a_dataset_fails_is_not_made(monkeypatch: pytest.MonkeyPatch) -> None:
    publish_all = on_demand.publish_all

    def failing(recipes, *, jobs):  # type: ignore[no-untyped-def]
        yield on_demand.publish_recipe(recipes[0])
        yield from publish_all(
            [type(recipe)(recipe.variant, recipe.tier, policy=Path("none.zip")) for recipe in recipes[1:]]
        )

    monkeypatch.setattr(on_demand, "publish_all", failing)
    with pytest.raises(DatasetNotFoundError, match=r"was not made; .*none\.zip$"):
        load_dataset("imujoco/hopper-friction-random-v0", quiet=True)
    assert minari_root.exists(FEET[0])
    assert not minari_root.exists("imujoco/hopper-friction-random-v0")
