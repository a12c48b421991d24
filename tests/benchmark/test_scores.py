"""Scores and the page, from lines that are made up: every number can be computed by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from imujoco_minari.benchmark.figures import few_shot_figures
from imujoco_minari.benchmark.lines import policies_sha256
from imujoco_minari.benchmark.page import Results, results_page, sections
from imujoco_minari.benchmark.reproduction import SHOTS, STEPS
from imujoco_minari.benchmark.scores import few_shot_scores, offline_scores, to_csv
from imujoco_minari.benchmark.tables import few_shot_tables
from imujoco_minari.variants import Variant

VARIANTS = ("hopper-massinc_200_leggeom", "hopper-massdec_50_leggeom", "hopper-frictiondec_50_feet")


def few_shot_line(
    method: str, variant: str, seed: int, score: float, budget: str = "5x100"
) -> dict[str, Any]:
    result = {"returns": [100.0 + 1000.0 * score] * 2, "error": 0.5}
    return {
        "protocol": "few-shot-v1",
        "method": method,
        "split": "hopper-extremes-v1",
        "tier": "expert",
        "variant": variant,
        "budget": budget,
        "seed": seed,
        "versions": {"jax": "1.0"},
        "references": [100.0, 1100.0],
        "policies_sha256": policies_sha256((Variant("hopper"), Variant.parse(variant))),
        "results": {"0": result, "25": result},
    }


def offline_line(method: str, seed: int, score: float) -> dict[str, Any]:
    names = ("hopper-base", "hopper-frictiondec_50_feet")
    return {
        "protocol": "offline-v1",
        "method": method,
        "robot": "hopper",
        "tier": "medium-expert",
        "seed": seed,
        "checkpoints": [5, 10],
        "versions": {"jax": "1.0"},
        "variants": names,
        "references": {name: [0.0, 100.0] for name in names},
        "policies_sha256": policies_sha256(tuple(map(Variant.parse, names))),
        "results": {
            name: {str(n): {"returns": [10.0 * n * score / (i + 1)]} for n in (5, 10)}
            for i, name in enumerate(names)
        },
    }


FEW = [
    few_shot_line(method, variant, seed, (place + seed) / 10, budget)
    for budget in ("1x100", "5x100")
    for method in ("scratch", "maml", "mine")
    for place, variant in enumerate(VARIANTS)
    for seed in (0, 1)
] + [few_shot_line("told", variant, seed, 0.8, "1x100") for variant in VARIANTS for seed in (0, 1)]
REPRODUCED = [
    {
        "protocol": "published-2026",
        "method": "fine-tuning",
        "seed": seed,
        "versions": {"jax": "1.0"},
        "results": {str(n): {str(k): 0.3 for k in STEPS} | {"5": 0.4 + seed / 5} for n in SHOTS},
    }
    for seed in (0, 1)
]
ACROSS = [
    offline_line(method, seed, 0.4 + seed / 10)
    | {"protocol": "across-v1"}
    | {"results": {"hopper-frictiondec_50_feet": {str(n): {"returns": [n * (4.0 + seed)]} for n in (5, 10)}}}
    for method in ("bc", "bc-told")
    for seed in (0, 1)
]
OFF = [offline_line(method, seed, 0.4 + seed / 10) for method in ("bc", "iql") for seed in (0, 1)]


def test_a_score_is_the_interquartile_mean_over_variants_and_seeds() -> None:
    scores = {(s.method, s.budget, s.steps, s.category): s for s in few_shot_scores(FEW)}
    whole = scores["scratch", "5x100", 25, "all"]
    # The scores are 0, .1, .1, .2, .2 and .3; one of six is left out at each end.
    assert whole.iqm == pytest.approx(0.15)
    assert whole.low <= whole.iqm <= whole.high
    assert (whole.variants, whole.runs, whole.error) == (3, 2, 0.5)
    mass = scores["scratch", "5x100", 25, "mass"]
    assert (mass.iqm, mass.variants) == (pytest.approx(0.1), 2)
    assert (
        scores["told", "1x100", 0, "all"].low == scores["told", "1x100", 0, "all"].high == pytest.approx(0.8)
    )


def test_the_interval_over_variants_contains_their_spread() -> None:
    """Two seeds agree and three variants differ: the interval over seeds is a point, the other is not."""
    lines = [
        few_shot_line("maml", variant, seed, place / 10)
        for place, variant in enumerate(VARIANTS)
        for seed in (0, 1)
    ]
    (score,) = (s for s in few_shot_scores(lines) if (s.category, s.steps) == ("all", 0))
    assert score.interval == pytest.approx((0.1, 0.1, 0.1))
    assert (score.wide_low, score.wide_high) == pytest.approx((0.0, 0.2))
    assert "| maml | 0 | 0.10 (0.10 to 0.10) [0.00 to 0.20] |" in few_shot_tables([score])


def test_a_seed_that_a_variant_lacks_is_left_out() -> None:
    lines = [few_shot_line("maml", VARIANTS[0], seed, seed / 10) for seed in (1, 2)]
    lines += [few_shot_line("maml", VARIANTS[1], seed, seed / 10) for seed in (0, 1)]
    score = few_shot_scores(lines)[0]
    assert (score.iqm, score.runs, score.variants) == (pytest.approx(0.1), 1, 2)
    # No seed serves both variants.
    assert few_shot_scores([lines[1], lines[2]]) == []
    other = few_shot_line("maml", VARIANTS[2], 0, 0.1)
    apart = few_shot_scores([lines[1], other])
    assert {score.category for score in apart} == {"mass", "friction"}
    assert (few_shot_tables(apart), few_shot_figures(apart)) == ("", [])


def test_offline_scores_separate_the_base_from_the_variants() -> None:
    scores = {(s.steps, s.category): s.iqm for s in offline_scores(OFF) if s.method == "bc"}
    expected = {(10, "base"): 0.45, (10, "shifted"): 0.225, (10, "friction"): 0.225}
    expected |= {(5, category): value / 2 for (_, category), value in expected.items()}
    assert scores == pytest.approx(expected)


def test_figures_of_few_shot_scores_need_more_than_one_budget_or_tier() -> None:
    one_tier = few_shot_figures(few_shot_scores(FEW))
    assert [figure.name for figure in one_tier] == [
        "few-shot-extremes-v1-expert-data",
        "few-shot-extremes-v1-expert-steps",
    ]
    sampled = [line | {"tier": "expert-stochastic"} for line in FEW if line["budget"] == "5x100"]
    by_tier, *others = few_shot_figures(few_shot_scores(FEW + sampled))
    assert (by_tier.name, by_tier.ticks) == ("few-shot-tiers", ("expert", "expert-stochastic"))
    intervals = by_tier.panels["hopper-extremes-v1"]["scratch"]
    assert intervals[0] == intervals[1]
    names = [figure.name for figure in others]
    assert "few-shot-extremes-v1-expert-stochastic-steps" in names
    assert "few-shot-extremes-v1-expert-stochastic-data" not in names


def test_a_budget_and_an_algorithm_of_a_user_are_shown_too() -> None:
    lines = [few_shot_line("maml", variant, 0, 0.5, "3x50") for variant in VARIANTS]
    results = Results(lines, [offline_line(method, 0, 0.4) for method in ("mine", "mine †", "iql")], [], [])
    few_shot, offline = sections(results)
    assert "| method | steps | 3x50 |\n" in few_shot.tables
    # There is nothing to compare with it.
    assert few_shot.figures == []
    assert all(list(figure.panels["hopper"]) == ["iql", "mine"] for figure in offline.figures)
    assert few_shot.tables in results_page(results, [few_shot, offline])


def test_the_page_has_every_method_and_its_files_are_reproducible(tmp_path: Path) -> None:
    from imujoco_minari.pictures.plotting.scores import plot_scores

    few_scores = few_shot_scores(FEW)
    results = Results(FEW, OFF, ACROSS, REPRODUCED)
    parts = sections(results)
    text = results_page(results, parts, "What was found.")
    assert text == results_page(results, sections(results), "What was found.")
    assert text.index("![") < text.index("What was found.") < text.index("<details>")
    assert "| mine | 25 | 0.15 (" in text
    assert "<summary>hopper-extremes-v1, expert, 3 held-out variants</summary>" in text
    without = [line for line in FEW if line["budget"] == "5x100" or line["method"] == "told"]
    columns = "| method | steps | 5x100 | mass, 5x100 | friction, 5x100 |\n"
    assert columns in few_shot_tables(few_shot_scores(without))
    same = "0.80 (0.80 to 0.80) [0.80 to 0.80]"
    assert f"| told | 0 | {same} | {same} | {same} | 0.80 (0.80 to 0.80) |" in text
    assert "| medium-expert | 5 | 0.2" in text
    assert "| medium-expert | 10 | 0.45 (" in text
    assert "| hopper | friction | 0.2" in text
    assert "| fine-tuning | 25 | 0.300 ± 0.000 | 0.500 ± 0.100 | 0.300 ± 0.000 |" in text
    assert "| fine-tuning, published | 25 |  | 0.443 |  | 0.330 |  |  | 0.234 |" in text
    assert "| shifted | 10 | 0.45 (0.40 to 0.50) |" in text
    assert "| friction | 10 | 0.45 (0.40 to 0.50) |" in text
    figures = [figure for part in parts for figure in part.figures]
    assert figures[-1].name == "reproduction"
    for figure in figures:
        assert f"results-figures/{figure.name}.svg" in text
        labels = (figure.title, figure.x_label, figure.y_label)
        files = plot_scores(figure.panels, figure.ticks, labels, tmp_path / figure.name)
        svg = files[-1].read_text("utf-8")
        for method in {method for panel in figure.panels.values() for method in panel}:
            assert method in svg
    assert len(to_csv(few_scores).splitlines()) == 1 + len(few_scores)


@pytest.mark.parametrize("kind", ["few_shot", "offline", "across"])
def test_the_page_says_that_a_line_is_of_an_earlier_expert(kind: str) -> None:
    now = Results(FEW, OFF, ACROSS, REPRODUCED)
    first, *others = getattr(now, kind)
    before = replace(now, **{kind: [first | {"policies_sha256": "0"}, *others]})
    pages = [results_page(each, sections(each)) for each in (now, before)]
    assert ["earlier experts" in page for page in pages] == [False, True]
    title = {
        "few_shot": "Few-shot imitation",
        "offline": "Offline learning",
        "across": "Learning across variants",
    }
    assert f"this version ships: {title[kind]}. They" in " ".join(pages[1].split())


def test_demonstrators_of_one_tier_after_other_training_data_are_apart() -> None:
    own = few_shot_line("mine", VARIANTS[0], 0, 0.5) | {"tier": "control"}
    scores = few_shot_scores([own, own | {"train_tier": "expert"}, own | {"train_tier": "random"}])
    tiers = {score.tier for score in scores}
    assert tiers == {"control", "control (trained on expert)", "control (trained on random)"}
