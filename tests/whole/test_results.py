"""The published results are of the policies that are shipped now, and of their datasets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from hashlib import sha256
from itertools import product
from pathlib import Path

from imujoco_minari.benchmark import few_shot, offline, reproduction
from imujoco_minari.benchmark.lines import policies_sha256, read_lines, references
from imujoco_minari.benchmark.methods import METHODS, settings_of
from imujoco_minari.policies import expert_actor
from imujoco_minari.variants import EXPERT, ROBOTS, Variant, catalogue, held_out
from imujoco_minari.verification.published import published_entry

DOCS = Path(__file__).parents[2] / "docs"
RESULTS = DOCS / "results"
LINES = read_lines(RESULTS / few_shot.FILE)
OFFLINE = read_lines(RESULTS / offline.FILE)
REPRODUCED = read_lines(RESULTS / reproduction.FILE)
# The seeds of the published offline lines. With the next results: offline.SEEDS.
PUBLISHED_SEEDS = 3


def content(dataset_id: str) -> str:
    return str(published_entry(dataset_id)["content_sha256"])


def digest(dataset_ids: Sequence[str]) -> str:
    return sha256(" ".join(map(content, dataset_ids)).encode()).hexdigest()


def test_each_line_is_of_the_shipped_experts_and_their_published_datasets() -> None:
    assert LINES
    for line in LINES:
        variant = Variant.parse(line["variant"])
        assert line["policies_sha256"] == policies_sha256((variant.base, variant))
        assert line["references"] == references(variant)
        # Only the experts' datasets have published digests.
        if line["tier"] == EXPERT:
            assert line["data_sha256"] == content(variant.dataset_id())
        assert line["settings"] == settings_of(METHODS[line["method"]](0))
    train = {
        (line["split"], line["train_sha256"])
        for line in LINES
        if line["train_sha256"] and line["tier"] == EXPERT
    }
    for split, found in train:
        assert found == digest([Variant.parse(variant).dataset_id() for variant in held_out(split).train])


def test_the_splits_are_whole() -> None:
    for name, tier in {(line["split"], line["tier"]) for line in LINES}:
        own = [line for line in LINES if (line["split"], line["tier"]) == (name, tier)]
        cells = {(line["method"], line["variant"], line["budget"], line["seed"]) for line in own}
        # Five methods with these budgets, three with one, and five seeds.
        budgets = 1 if tier != EXPERT else 2 if "extremes" in name else 5
        assert len(own) == len(cells) == len(held_out(name).test) * (5 * budgets + 3) * 5


def test_the_page_counts_the_variants_with_their_own_expert() -> None:
    text = (DOCS / "results.md").read_text("utf-8")
    whole = 0
    for robot in ROBOTS:
        weights = {
            str(variant): expert_actor(variant).weights["mu.weight"].tobytes()
            for variant in (Variant(robot), *catalogue(robot))
        }
        shared = Counter(weights.values())
        for split in (f"{robot}-random-v1", f"{robot}-extremes-v1"):
            test = held_out(split).test
            own = sum(shared[weights[variant]] == 1 for variant in test)
            whole += own
            if any(line["split"] == split for line in LINES):
                assert (
                    f"<summary>{split}, expert</summary>\n\n{own} of {len(test)} held-out variants with"
                    in text
                )
    assert f"{whole} of the 101." in (DOCS / "benchmark.md").read_text("utf-8")


def test_the_offline_lines_are_whole_and_of_the_shipped_experts() -> None:
    assert OFFLINE
    for line in OFFLINE:
        variants = tuple(map(Variant.parse, line["variants"]))
        assert line["policies_sha256"] == policies_sha256(variants)
        assert line["references"] == {str(variant): references(variant) for variant in variants}
        assert line["settings"] == offline.algorithm_settings(offline.ALGORITHMS[line["method"]])
        assert line["checkpoints"] == offline.OfflineGrid().checkpoints()
    data = {(line["robot"], line["tier"], line["data_sha256"]) for line in OFFLINE}
    tiers = {line["tier"] for line in OFFLINE}
    assert len(data) == len(ROBOTS) * len(tiers)
    cells = {(line["method"], line["robot"], line["tier"], line["seed"]) for line in OFFLINE}
    grid = offline.OfflineGrid(tiers=sorted(tiers), seeds=range(PUBLISHED_SEEDS))
    assert len(OFFLINE) == len(cells) == grid.cells()


def test_the_published_comparison_is_whole_and_of_the_published_datasets() -> None:
    cells = [(line["method"], line["seed"]) for line in REPRODUCED]
    assert sorted(cells) == sorted(product(reproduction.METHODS, range(reproduction.SEEDS)))
    train, test = map(digest, reproduction.published_split())
    for line in REPRODUCED:
        assert line["settings"] == asdict(reproduction.DEFAULT)
        assert (line["train_sha256"], line["data_sha256"]) == (train, test)


def test_the_docs_name_the_variants_of_the_offline_evaluation() -> None:
    text = (DOCS / "benchmark.md").read_text("utf-8")
    for robot in ROBOTS:
        names = [name.partition("-")[2] for name in offline.SHIFTED_VARIANTS if name.startswith(robot)]
        row = " | ".join(f"`{name}`" for name in (robot, *names))
        assert f"| {row} |" in text
