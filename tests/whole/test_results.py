"""The published results are of the policies that are shipped now, and of their datasets."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

from imujoco_minari.benchmark.lines import policies_sha256, read_lines, references
from imujoco_minari.benchmark.methods import METHODS, settings_of
from imujoco_minari.variants import Variant, held_out
from imujoco_minari.verification.published import published_entry

LINES = read_lines(Path(__file__).parents[2] / "docs" / "results" / "few-shot.jsonl")


def content(variant: str) -> str:
    return str(published_entry(Variant.parse(variant).dataset_id())["content_sha256"])


def test_each_line_is_of_the_shipped_experts_and_their_published_datasets() -> None:
    assert LINES
    for line in LINES:
        variant = Variant.parse(line["variant"])
        assert line["policies_sha256"] == policies_sha256((variant.base, variant))
        assert line["references"] == references(variant)
        assert line["data_sha256"] == content(line["variant"])
        assert line["settings"] == settings_of(METHODS[line["method"]](0))
    train = {(line["split"], line["train_sha256"]) for line in LINES if line["train_sha256"]}
    for split, digest in train:
        assert digest == sha256(" ".join(map(content, held_out(split).train)).encode()).hexdigest()


def test_the_splits_are_whole() -> None:
    for name in {line["split"] for line in LINES}:
        own = [line for line in LINES if line["split"] == name]
        cells = {(line["method"], line["variant"], line["budget"], line["seed"]) for line in own}
        # Five methods with these budgets, three with one, and five seeds.
        budgets = 2 if "extremes" in name else 5
        assert len(own) == len(cells) == len(held_out(name).test) * (5 * budgets + 3) * 5
