"""The published results are whole, and of the shipped experts, or the page says that they are not."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from hashlib import sha256
from itertools import product
from pathlib import Path

from imujoco_minari.benchmark import few_shot, offline, protocol, reproduction
from imujoco_minari.benchmark.lines import Line, is_of_earlier_experts, read_lines, references
from imujoco_minari.benchmark.methods import COMPARISONS, METHODS, settings_of
from imujoco_minari.variants import EXPERT, ROBOTS, Variant, held_out
from imujoco_minari.verification.published import published_entry

DOCS = Path(__file__).parents[2] / "docs"
RESULTS = DOCS / "results"
LINES = read_lines(RESULTS / few_shot.FILE)
OFFLINE = read_lines(RESULTS / offline.FILE)
ACROSS = read_lines(RESULTS / offline.ACROSS_FILE)
REPRODUCED = read_lines(RESULTS / reproduction.FILE)
# Whether some lines are of earlier experts than the shipped ones. They are computed again then.
EARLIER = any(map(is_of_earlier_experts, (*LINES, *OFFLINE, *ACROSS)))
# What the published lines have. With the next results (`scripts/results`) they also have offline.SEEDS of
# medium-expert, LARGE_TIERS, and 3 seeds across variants.
PUBLISHED_FAMILIES = ["descendant", "specialist"]
PUBLISHED_SEEDS = {"medium": 3, "medium-replay": offline.SEEDS, "medium-expert": 3}
PUBLISHED_LARGE_TIERS: list[str] = []
PUBLISHED_ACROSS_SEEDS = 0


def digest(dataset_ids: Sequence[str]) -> str:
    """Return the digest of experts' datasets, by the list of the published ones."""
    recipes = []
    for dataset_id in dataset_ids:
        recipe = {
            key: published_entry(dataset_id)[key] for key in ("policy_sha256", "seed", "total_episodes")
        }
        recipes.append([dataset_id, recipe | {"policy_deterministic": True}])
    return sha256(json.dumps(recipes, sort_keys=True).encode()).hexdigest()


def assert_one_value(lines: Sequence[Line], key: str, of: Sequence[str]) -> None:
    """Assert that all lines with the same values of ``of`` have the same value of ``key``."""
    values = {(*(line[each] for each in of), json.dumps(line[key], sort_keys=True)) for line in lines}
    assert values
    assert len(values) == len({value[:-1] for value in values})


def test_the_page_says_whether_lines_are_of_earlier_experts() -> None:
    assert ("earlier experts" in (DOCS / "results.md").read_text("utf-8")) is EARLIER


def test_all_lines_of_a_variant_are_of_the_same_experts_and_data() -> None:
    assert_one_value(LINES, "policies_sha256", ["variant"])
    assert_one_value(LINES, "references", ["variant"])
    assert_one_value(LINES, "data_sha256", ["variant", "tier"])
    learnt = [{**line, "tier": few_shot.train_tier(line)} for line in LINES if line["train_sha256"]]
    assert_one_value(learnt, "train_sha256", ["split", "tier"])
    assert {line["split"] for line in learnt} == {line["split"] for line in LINES}


def test_the_lines_of_shipped_experts_are_of_their_published_datasets() -> None:
    for line in LINES:
        assert line["settings"] == settings_of(METHODS[line["method"]](0))
        if is_of_earlier_experts(line):
            continue
        variant = Variant.parse(line["variant"])
        assert line["references"] == references(variant)
        # Only the experts' datasets have published digests.
        if line["tier"] == EXPERT:
            assert line["data_sha256"] == digest([variant.dataset_id()])
    train = {
        (line["split"], line["train_sha256"])
        for line in LINES
        if line["train_sha256"] and few_shot.train_tier(line) == EXPERT and not is_of_earlier_experts(line)
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
        for (split, tier), method in product(groups, METHODS)
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


def test_the_offline_lines_are_whole_and_of_one_expert() -> None:
    for key in ("policies_sha256", "references", "data_sha256"):
        assert_one_value(OFFLINE, key, ["robot", "tier"])
    for line in (*OFFLINE, *ACROSS):
        if not is_of_earlier_experts(line):
            assert line["references"] == {name: references(Variant.parse(name)) for name in line["variants"]}
        known = offline.ACROSS_ALGORITHMS if line["protocol"] == offline.ACROSS else offline.ALGORITHMS
        assert line["settings"] == offline.algorithm_settings(known[line["method"]])
        assert line["checkpoints"] == offline.OfflineGrid().checkpoints()
    found = [tuple(line[key] for key in ("method", "robot", "tier", "seed")) for line in OFFLINE]
    whole = {
        cell
        for tier, seeds in PUBLISHED_SEEDS.items()
        for cell in product(offline.ALGORITHMS, ROBOTS, [tier], range(seeds))
    }
    whole |= {*product(["iql"], ROBOTS, PUBLISHED_LARGE_TIERS, range(3))}
    assert len(found) == len(whole)
    assert set(found) == whole
    across = sorted((line["method"], line["robot"], line["seed"]) for line in ACROSS)
    assert across == sorted(product(offline.ACROSS_ALGORITHMS, ROBOTS, range(PUBLISHED_ACROSS_SEEDS)))


def test_the_published_comparison_is_whole_and_of_the_same_datasets() -> None:
    cells = [(line["method"], line["seed"]) for line in REPRODUCED]
    assert sorted(cells) == sorted(product(reproduction.METHODS, range(reproduction.SEEDS)))
    assert all(line["settings"] == asdict(reproduction.DEFAULT) for line in REPRODUCED)
    ((*found,),) = {(line["train_sha256"], line["data_sha256"]) for line in REPRODUCED}
    earlier = found != list(map(digest, reproduction.published_split()))
    assert ("on our earlier datasets" in (RESULTS / "findings.md").read_text("utf-8")) is earlier


def test_the_docs_name_the_variants_of_the_offline_evaluation() -> None:
    text = (DOCS / "benchmark.md").read_text("utf-8")
    for robot in ROBOTS:
        names = [name.partition("-")[2] for name in offline.SHIFTED_VARIANTS if name.startswith(robot)]
        row = " | ".join(f"`{name}`" for name in (robot, *names))
        assert f"| {row} |" in text
