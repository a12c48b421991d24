"""A dataset that is not in the Minari root: the error names the command that makes it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from imujoco_minari.errors import DatasetNotFoundError
from imujoco_minari.loading.load import arrays
from imujoco_minari.pictures.rendering.motion import replay
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.storage.missing import making, not_in_root
from imujoco_minari.verification import verify


@pytest.mark.parametrize(
    ("dataset_id", "command"),
    [
        ("imujoco/hopper-base-v0", "imujoco publish hopper-base"),
        (
            "imujoco/hopper-massdec_25_leggeom-random-v0",
            "imujoco publish hopper-massdec_25_leggeom --tier random",
        ),
        ("imujoco/hopper-base-medium-expert-v0", "imujoco publish hopper-base --tier medium-expert"),
        ("imujoco/hopper-base-replay-v0", "imujoco train hopper-base --record-replay"),
        ("imujoco/hopper-all-v0", "imujoco combine --robot hopper"),
        ("imujoco/hopper-mass-random-v0", "imujoco combine --robot hopper --category mass --tier random"),
        ("imujoco-original/hopper-massdec_25_leggeom-v0", "imujoco import-archive DIR"),
        ("imujoco/hopper-mine-v0", ""),
        ("imujoco/hopper-base-v1", ""),
        ("imujoco/crab-all-v0", ""),
        ("D4RL/door/human-v2", ""),
    ],
)
def test_the_command_that_makes_a_dataset(dataset_id: str, command: str, root: Path) -> None:
    assert making(dataset_id) == command
    message = str(not_in_root(dataset_id))
    assert message.startswith(f"{dataset_id} is not in the Minari root, at {root}/{dataset_id}; ")
    advice = f"make it with `{command}`" if command else "see `minari list local`"
    assert message.partition("; ")[2].startswith(advice)
    assert ("It names no variant: " in message) == (not command and dataset_id.startswith("imujoco/"))


@pytest.mark.parametrize(
    "call", [verify, arrays, replay, lambda name: combine_datasets([name], "imujoco/x-v0")]
)
def test_everything_that_reads_a_dataset_names_it(call: Callable[[str], object]) -> None:
    with pytest.raises(DatasetNotFoundError, match="make it with `imujoco publish hopper-base`"):
        call("imujoco/hopper-base-v0")


def test_a_misspelt_variant_is_named() -> None:
    message = str(not_in_root("imujoco/hopper-massdec_25_legeom-random-v0"))
    assert "It names no variant: " in message
    assert "(did you mean 'leggeom'?)" in message
