"""The published results are of the policies that are shipped now, and of their datasets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from hashlib import sha256
from itertools import product
from pathlib import Path

from imujoco_minari.benchmark import few_shot, offline, protocol, reproduction
from imujoco_minari.benchmark.lines import policies_sha256, read_lines, references
from imujoco_minari.benchmark.methods import COMPARISONS, METHODS, settings_of
from imujoco_minari.policies import expert_actor
from imujoco_minari.variants import EXPERT, ROBOTS, Variant, catalogue, held_out
from imujoco_minari.verification.published import published_entry

DOCS = Path(__file__).parents[2] / "docs"
RESULTS = DOCS / "results"
LINES = read_lines(RESULTS / few_shot.FILE)
OFFLINE = read_lines(RESULTS / offline.FILE)
ACROSS = read_lines(RESULTS / offline.ACROSS_FILE)
REPRODUCED = read_lines(RESULTS / reproduction.FILE)
# What the published lines have. With the next results (`scripts/results`) they have all METHODS, the families
# ["descendant", "specialist"], offline.SEEDS, LARGE_TIERS, and 3 seeds across variants.
PUBLISHED_METHODS = [method for method in METHODS if method not in ("history", "universal")]
PUBLISHED_FAMILIES: list[str] = []
PUBLISHED_SEEDS = 3
PUBLISHED_LARGE_TIERS: list[str] = []
PUBLISHED_ACROSS_SEEDS = 0


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


def budgets(method: str, split: str, tier: str) -> Sequence[str]:
    if method in COMPARISONS:
        return ["1x100"]
    if tier != EXPERT:
        return ["5x100"]
    # It takes as long as all other methods together.
    return ["5x100", "1xall"] if method == "history" else list(map(str, protocol.budgets_of(held_out(split))))


def test_the_splits_are_whole() -> None:
    own = [line for line in LINES if "train_tier" not in line]
    found = [
        tuple(line[key] for key in ("split", "tier", "method", "variant", "budget", "seed")) for line in own
    ]
    groups = [(f"{robot}-{kind}-v1", EXPERT) for robot in ROBOTS for kind in ("random", "extremes")]
    groups += [(f"{robot}-random-v1", "expert-stochastic") for robot in ROBOTS]
    wanted = {
        (split, tier, method, variant, budget, seed)
        for (split, tier), method in product(groups, PUBLISHED_METHODS)
        for variant, budget, seed in product(
            held_out(split).test, budgets(method, split, tier), range(protocol.SEEDS)
        )
    }
    assert len(found) == len(wanted)
    assert set(found) == wanted


def test_demonstrations_by_two_families_have_the_same_cells() -> None:
    keys = ("split", "train_tier", "method", "variant", "budget", "seed")
    families: dict[str, set[tuple[str, ...]]] = {}
    for line in LINES:
        if "train_tier" in line:
            families.setdefault(line["tier"], set()).add(tuple(line[key] for key in keys))
    assert sorted(families) == PUBLISHED_FAMILIES
    assert all(cells == families[PUBLISHED_FAMILIES[0]] for cells in families.values())


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
    for line in (*OFFLINE, *ACROSS):
        variants = tuple(map(Variant.parse, line["variants"]))
        assert line["policies_sha256"] == policies_sha256(variants)
        assert line["references"] == {str(variant): references(variant) for variant in variants}
        known = offline.ACROSS_ALGORITHMS if line["protocol"] == offline.ACROSS else offline.ALGORITHMS
        assert line["settings"] == offline.algorithm_settings(known[line["method"]])
        assert line["checkpoints"] == offline.OfflineGrid().checkpoints()
    data = {(line["robot"], line["tier"], line["data_sha256"]) for line in OFFLINE}
    tiers = {line["tier"] for line in OFFLINE}
    assert len(data) == len(ROBOTS) * len(tiers)
    found = [tuple(line[key] for key in ("method", "robot", "tier", "seed")) for line in OFFLINE]
    whole = {*product(offline.ALGORITHMS, ROBOTS, offline.TIERS, range(PUBLISHED_SEEDS))}
    whole |= {*product(["iql"], ROBOTS, PUBLISHED_LARGE_TIERS, range(3))}
    assert len(found) == len(whole)
    assert set(found) == whole
    across = sorted((line["method"], line["robot"], line["seed"]) for line in ACROSS)
    assert across == sorted(product(offline.ACROSS_ALGORITHMS, ROBOTS, range(PUBLISHED_ACROSS_SEEDS)))


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
