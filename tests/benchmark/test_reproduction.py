"""The published protocol: its split, and a tiny run of both methods."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from imujoco_minari.benchmark import reproduction
from imujoco_minari.benchmark.checks import changes
from imujoco_minari.benchmark.reproduction import (
    METHODS,
    Choices,
    comparison,
    published_split,
    run_reproduction,
)
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.variants import Variant, catalogue

TINY = Choices(2, 1.0, 2, 8, 1e-3, 1, 2)


def test_the_split_is_that_of_the_file_names() -> None:
    names = sorted(f"sac-{variant}.npz" for variant in catalogue("halfcheetah"))
    random.Random(42).shuffle(names)
    train, test = published_split()
    assert (len(train), len(test)) == (42, 11)
    assert [f"sac-{name[len('imujoco/') : -len('-v0')]}.npz" for name in train + test] == names


def test_a_tiny_run_of_both_methods(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    variants = [Variant.parse(f"halfcheetah-massinc_{percent}_bfoot") for percent in (50, 100, 200)]
    for variant in variants:
        publish(variant, tier="random", episodes=2)
    ids = [variant.dataset_id("random") for variant in variants]
    monkeypatch.setattr(reproduction, "published_split", lambda: (ids[:2], ids[2:]))
    monkeypatch.setattr(reproduction, "SHOTS", (1, 5))
    monkeypatch.setattr(reproduction, "STEPS", (1, 25))
    lines = run_reproduction(tmp_path, seeds=[0], choices=TINY)
    assert lines == run_reproduction(tmp_path, seeds=[0], choices=TINY)
    assert changes(lines) == [f"the settings of {method} have changed (lines: 1)" for method in METHODS[::-1]]
    rows = {(row.method, row.windows, row.steps): row for row in comparison(lines)}
    assert len(rows) == 8
    assert rows["maml", 5, 25].published is None
    # Random actions cannot be predicted, and a network that hardly learnt predicts about their mean.
    assert all(0.8 < row.error < 2.0 for row in rows.values())
    assert rows["fine-tuning", 1, 1].error != rows["fine-tuning", 1, 25].error
