"""The HTML pages of the gallery, from the templates in ``site``. They load nothing from other sites."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from imujoco_minari.envs.categories import BY_NAME
from imujoco_minari.envs.differences import Difference
from imujoco_minari.pictures.gallery.clips import SIZE
from imujoco_minari.pictures.gallery.entries import Entry, ResultTable, Score, normalised
from imujoco_minari.pictures.rendering.film import changes_in_words
from imujoco_minari.policies.tiers import RANDOM
from imujoco_minari.variants import BASE, CATEGORIES, COMPOUND, EXPERT, Variant, specification

MINUS, DASH, SPACE = "\N{MINUS SIGN}", "\N{EN DASH}", "\N{NO-BREAK SPACE}"


def index_page(entries: Sequence[Entry]) -> str:
    """Return the first page: all variants, with filters and sorting."""
    variants = [entry.variant for entry in entries]
    changes = [change for variant in variants for change in variant.changes]
    categories = {variant.category for variant in variants} | {BASE}
    robots = {variant.robot: specification(variant.robot).title for variant in variants}
    *titles, last_title = robots.values() or ["nothing"]
    base_of = {entry.variant: entry for entry in entries if entry.variant.category == BASE}
    return _render(
        "index.html",
        cards=[(entry, normalised(entry.best, base_of.get(entry.variant.base))) for entry in entries],
        changed=len(entries) - len(base_of),
        bases=len(base_of),
        experts=sum(entry.best.tier == EXPERT for entry in entries),
        titles=f"{', '.join(titles)} and {last_title}" if titles else last_title,
        legend=[
            (name, BY_NAME[name].quantity)
            for name in CATEGORIES
            if name in {change.category for change in changes}
        ],
        robots=robots.items(),
        categories=[(name, name) for name in (*CATEGORIES, COMPOUND, BASE) if name in categories],
        bodies=[(body, body) for body in sorted({change.body for change in changes})],
        percents=[
            (percent, _format_percent(percent))
            for percent in sorted({change.percent for change in changes if change.percent})
        ],
    )


def variant_page(
    entry: Entry,
    base: Entry | None,
    neighbours: tuple[Variant | None, Variant | None],
    results: Sequence[ResultTable] = (),
) -> str:
    """Return the page of one variant, with the clip and the returns of its base robot for comparison.

    ``neighbours`` are the variants of the previous and the next page, ``results`` tables of methods' results.
    """
    variant = entry.variant
    figures = [(entry, "unchanged" if variant.category == BASE else "as changed")]
    if base is not None and variant.category != BASE:
        figures.insert(0, (base, "base robot"))
    return _render(
        "variant.html",
        root="../",
        variant=variant,
        figures=figures,
        changes=[_change_row(change) for change in entry.changes],
        scores=[_score_row(variant, score, base) for score in entry.scores],
        results=results,
        snippets=snippets(entry),
        previous=neighbours[0],
        next=neighbours[1],
    )


def _render(template: str, **values: Any) -> str:
    page = {"root": "", "version": version("imujoco-minari"), "width": SIZE[0], "height": SIZE[1]}
    return _environment().get_template(template).render(page | values)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("imujoco_minari.pictures.gallery", "site"),
        autoescape=True,
        trim_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters |= {
        "breakable": _add_break_points,
        "clip_words": _clip_words,
        "counted": lambda count, noun: f"{count} {noun}{'' if count == 1 else 's'}",
        "number": _format_number,
        "search_words": _search_words,
        "share": _format_share,
        "short": short,
        "summary": summary,
    }
    return environment


def summary(variant: Variant) -> str:
    """Return in one sentence what a variant is."""
    page = specification(variant.robot)
    robot = f"{page.title} ({page.environment})"
    if not variant.changes:
        return f"{robot}, unchanged: all its variants are compared with it."
    changed = (
        f"the {BY_NAME[change.category].quantity} of {' and '.join(change.mjcf_names(variant.robot))} "
        f"changed by {_format(change.percent, '+g')}{SPACE}%"
        for change in variant.changes
    )
    return f"{robot} with {', and '.join(changed)}."


def short(variant: Variant) -> str:
    """Return what a variant changes, in a few words."""
    return changes_in_words(variant).replace("-", MINUS).replace(" %", f"{SPACE}%")


def snippets(entry: Entry) -> list[tuple[str, str, str]]:
    """Return title, text and language of the code that publishes, loads and runs a variant."""
    variant, tier = entry.variant, entry.clip.tier
    option = "" if tier == EXPERT else f" --tier {tier}"
    policy = f'"{variant}"' if tier == EXPERT else f'"{variant}", tier="{tier}"'
    load = f"""\
import minari

dataset = minari.load_dataset("{variant.dataset_id(tier)}")
episodes = dataset.sample_episodes(5)"""
    run = f"""\
import numpy as np

import imujoco_minari

env = imujoco_minari.make("{variant}")
policy = imujoco_minari.load_policy({policy})
rng = np.random.default_rng(0)
observation, info = env.reset(seed=0)
observation, reward, *flags = env.step(policy.act(observation, rng))"""
    return [
        ("Publish its dataset here", f"imujoco publish {variant}{option}", "shell"),
        ("Load the dataset", load, "Python"),
        ("Run the environment with the policy", run, "Python"),
    ]


def _search_words(variant: Variant) -> str:
    title = specification(variant.robot).title
    words = (str(variant), title, variant.category, *variant.mjcf_names, changes_in_words(variant))
    return " ".join(words).lower()


def _clip_words(entry: Entry) -> str:
    """Return what a variant's clip shows."""
    clip = entry.clip
    moved_by = "its expert policy" if clip.tier == EXPERT else "random actions"
    ending = f"the first {clip.seconds:.0f} s"
    if clip.ended:
        ending = f"it leaves its healthy range after {clip.seconds:.2f} s, which ends the episode"
    missing = "" if clip.tier == EXPERT else " It has no expert policy yet."
    return f"Moved by {moved_by}: {ending}, return {_format_number(clip.total)}.{missing}"


def _change_row(change: Difference) -> tuple[str, ...]:
    return (
        change.quantity,
        _format(change.before, ".5g"),
        _format(change.after, ".5g"),
        "" if change.unit == "1" else change.unit,
        DASH if change.before == 0 else _format_percent(100 * (change.after / change.before - 1)),
    )


def _score_row(variant: Variant, score: Score, base: Entry | None) -> tuple[str, ...]:
    of_base = None if base is None else base.score(score.tier)
    share = normalised(score, base)
    return (
        score.tier,
        f"{_format_number(score.return_mean)} ± {_format_number(score.return_std)}",
        DASH if of_base is None else _format_number(of_base.return_mean),
        DASH if share is None else _format_share(share),
        f"{score.length_mean:.0f} steps",
        str(score.episodes),
        score.algorithm if score.tier != RANDOM else "uniform actions",
        score.origin,
        Markup("<code>{}</code>").format(variant.dataset_id(score.tier)),
    )


def _add_break_points(variant: Variant) -> Markup:
    """Return an id as HTML that can break between its parts."""
    return Markup(escape(variant).replace("-", Markup("-<wbr>")).replace("_", Markup("_<wbr>")))


def _format(value: float, form: str) -> str:
    return f"{value:{form}}".replace("-", MINUS)


def _format_percent(percent: float) -> str:
    return _format(percent, "+.4g") + f"{SPACE}%"


def _format_number(value: float) -> str:
    return _format(value, ",.0f" if abs(value) >= 100 else ",.1f")


def _format_share(share: float) -> str:
    # Adding 0 makes a rounded -0 a 0.
    return _format(round(share, 2) + 0, ".2f")
