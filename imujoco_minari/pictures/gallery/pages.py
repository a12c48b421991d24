"""The HTML pages of the gallery. This module escapes every text. The pages load nothing from other sites."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from importlib.metadata import version
from string import Template

from imujoco_minari.envs.categories import BY_NAME
from imujoco_minari.envs.differences import Difference
from imujoco_minari.pictures.gallery.clips import SIZE
from imujoco_minari.pictures.gallery.entries import Entry, ResultTable, Score, normalised
from imujoco_minari.policies.tiers import RANDOM
from imujoco_minari.variants import BASE, CATEGORIES, COMPOUND, EXPERT, Variant, specification

MINUS, DASH, SPACE = "\N{MINUS SIGN}", "\N{EN DASH}", "\N{NO-BREAK SPACE}"


def index_page(entries: Sequence[Entry]) -> str:
    """Return the first page: all variants, with filters and sorting."""
    variants = [entry.variant for entry in entries]
    changed = sum(variant.category != BASE for variant in variants)
    bodies = sorted({change.body for variant in variants for change in variant.changes})
    order = (*CATEGORIES, COMPOUND)
    shown = sorted({v.category for v in variants} - {BASE}, key=order.index)
    experts = sum(entry.best.tier == EXPERT for entry in entries)
    robots = list(dict.fromkeys(variant.robot for variant in variants))
    titles = [specification(robot).title for robot in robots]
    base_of = {entry.variant: entry for entry in entries if entry.variant.category == BASE}
    return _load_template("index.html").substitute(
        count=f"{changed} of {changed} variants, {len(entries) - changed} of {len(entries) - changed} bases",
        changed=_format_count(changed, "variant"),
        bases=_format_count(len(entries) - changed, "base robot"),
        experts=experts,
        legend=_render_legend(variants),
        version=escape(version("imujoco-minari")),
        robots=_render_options(zip(robots, titles, strict=True)),
        titles=escape(" and ".join(filter(None, (", ".join(titles[:-1]), titles[-1])))),
        categories=_render_options((name, name) for name in (*shown, BASE)),
        bodies=_render_options((name, name) for name in bodies),
        percents=_render_options(
            (str(percent), _format_percent(percent))
            for percent in sorted({c.percent for v in variants for c in v.changes if c.percent})
        ),
        cards="\n".join(
            _render_card(entry, base_of.get(entry.variant.base), number)
            for number, entry in enumerate(entries)
        ),
    )


def variant_page(
    entry: Entry,
    base: Entry | None,
    neighbours: tuple[Variant | None, Variant | None],
    results: Sequence[ResultTable] = (),
) -> str:
    """Return the page of one variant.

    Args:
        entry: the facts about the variant.
        base: the facts about its base robot, whose clip and returns are shown for comparison.
        neighbours: the variants of the previous and the next page.
        results: tables of results of methods.
    """
    variant = entry.variant
    is_base = variant.category == BASE
    figures = [_render_figure(entry, "as changed" if not is_base else "unchanged")]
    if base is not None and not is_base:
        figures.insert(0, _render_figure(base, "base robot"))
    return _load_template("variant.html").substitute(
        name=escape(str(variant)),
        heading=_add_break_points(variant),
        summary=escape(summary(variant)),
        version=escape(version("imujoco-minari")),
        category=escape(variant.category),
        figures="\n".join(figures),
        both='<p><button type="button" class="button" id="both">Play both from the start</button></p>'
        if len(figures) > 1
        else "",
        changes=_render_changes(entry.changes),
        scores=_render_scores(entry, base),
        results=_render_results(results),
        code="\n".join(_render_code(title, text, language) for title, text, language in snippets(entry)),
        previous=_render_neighbour_link(neighbours[0], "prev", "Previous"),
        next=_render_neighbour_link(neighbours[1], "next", "Next"),
    )


def summary(variant: Variant) -> str:
    """Return in one sentence what a variant is."""
    page = specification(variant.robot)
    robot = f"{page.title} ({page.environment})"
    if not variant.changes:
        return f"{robot}, unchanged: all its variants are compared with it."
    changed = (
        f"the {BY_NAME[change.category].quantity} of {' and '.join(change.mjcf_names(variant.robot))} "
        f"changed by {_format_percent(change.percent)}"
        for change in variant.changes
    )
    return f"{robot} with {', and '.join(changed)}."


def snippets(entry: Entry) -> list[tuple[str, str, str]]:
    """Return title, text and language of the code that publishes, loads and runs a variant."""
    variant, tier = entry.variant, entry.clip.tier
    dataset = variant.dataset_id(tier)
    option = "" if tier == EXPERT else f" --tier {tier}"
    policy = f'"{variant}"' if tier == EXPERT else f'"{variant}", tier="{tier}"'
    return [
        ("Publish its dataset here", f"imujoco publish {variant}{option}", "shell"),
        (
            "Load the dataset",
            f'import minari\n\ndataset = minari.load_dataset("{dataset}")\n'
            "episodes = dataset.sample_episodes(5)",
            "Python",
        ),
        (
            "Run the environment with the policy",
            "import numpy as np\n\nimport imujoco_minari\n\n"
            f'env = imujoco_minari.make("{variant}")\n'
            f"policy = imujoco_minari.load_policy({policy})\n"
            "rng = np.random.default_rng(0)\n"
            "observation, info = env.reset(seed=0)\n"
            "observation, reward, *flags = env.step(policy.act(observation, rng))",
            "Python",
        ),
    ]


def _render_card(entry: Entry, base: Entry | None, number: int) -> str:
    variant, best = entry.variant, entry.best
    title, share = specification(variant.robot).title, normalised(best, base)
    words = (
        " ".join((str(variant), title, variant.category, *variant.mjcf_names, short(variant)))
        .lower()
        .replace(SPACE, " ")
    )
    return (
        f'<li class="card" data-robot="{variant.robot}" data-category="{variant.category}" '
        f'data-body="{escape(" ".join(change.body for change in variant.changes))}" '
        f'data-percent="{" ".join(str(change.percent) for change in variant.changes if change.percent)}" '
        f'data-return="{best.return_mean:.6g}" data-normalised="{"" if share is None else f"{share:.6g}"}" '
        f'data-order="{number}" data-words="{escape(words)}">'
        f'<a href="variants/{variant}.html">'
        f'<img src="portraits/{variant}.webp" width="{SIZE[0]}" height="{SIZE[1]}" loading="lazy" alt="">'
        f'<span class="name">{_add_break_points(variant)}</span></a>'
        f'<p class="what {variant.category}">{escape(short(variant))}</p>'
        f'<p class="score"><span class="tier">{escape(best.tier)}</span> '
        f"{_format_number(best.return_mean)}{_format_normalised(share)}</p></li>"
    )


def short(variant: Variant) -> str:
    """Return what a variant changes, in a few words."""
    parts = (
        f"{BY_NAME[change.category].noun} of {change.body} {_format_percent(change.percent)}"
        for change in variant.changes
    )
    return ", ".join(parts) or "unchanged"


def _render_figure(entry: Entry, label: str) -> str:
    variant, clip = entry.variant, entry.clip
    moved_by = "its expert policy" if clip.tier == EXPERT else "random actions"
    ending = (
        f"it leaves its healthy range after {clip.seconds:.2f} s, which ends the episode"
        if clip.ended
        else f"the first {clip.seconds:.0f} s"
    )
    missing = "" if clip.tier == EXPERT else " It has no expert policy yet."
    words = f"Moved by {moved_by}: {ending}, return {_format_number(clip.total)}.{missing}"
    return (
        f'<figure><video controls muted loop playsinline preload="metadata" width="{SIZE[0]}" '
        f'height="{SIZE[1]}" poster="../portraits/{variant}.webp" '
        f'aria-label="{escape(f"{variant}, {label}. {words}")}">'
        f'<source src="../clips/{variant}.mp4" type="video/mp4">'
        f'<a href="../clips/{variant}.mp4">The clip, an MP4 file</a></video>'
        f"<figcaption><strong>{_add_break_points(variant)}</strong>, {escape(label)}. {escape(words)}"
        "</figcaption></figure>"
    )


def _render_changes(changes: Sequence[Difference]) -> str:
    if not changes:
        return "<p>Nothing: this is the robot of Gymnasium&rsquo;s v5 environment.</p>"
    rows = (
        (
            escape(change.quantity),
            _format_significant(change.before),
            _format_significant(change.after),
            escape("" if change.unit == "1" else change.unit),
            _format_change(change),
        )
        for change in changes
    )
    return _render_table(
        "What changes, before and after", ("Quantity", "Base", "Variant", "Unit", "Change"), rows
    )


def _render_scores(entry: Entry, base: Entry | None) -> str:
    rows = (_format_score_row(entry.variant, score, base) for score in entry.scores)
    columns = (
        "Tier",
        "Return",
        "Base robot&rsquo;s",
        "Normalised",
        "Episode length",
        "Episodes",
        "Policy",
        "From",
        "Dataset",
    )
    return _render_table("Policies and returns", columns, rows, text=("Policy", "From", "Dataset"))


def _render_results(tables: Sequence[ResultTable]) -> str:
    if not tables:
        return ""
    rendered = (
        f"<h3>{escape(caption)}</h3>"
        + _render_table(escape(caption), list(map(escape, columns)), [list(map(escape, row)) for row in rows])
        for caption, columns, rows in tables
    )
    return (
        '<section aria-labelledby="results"><h2 id="results">Few-shot imitation</h2>'
        "<p>Normalised returns by method, gradient steps and demonstrations: 0 is the random policy, 1 the "
        "expert.</p>" + "".join(rendered) + "</section>"
    )


def _format_score_row(variant: Variant, score: Score, base: Entry | None) -> tuple[str, ...]:
    of_base = None if base is None else base.score(score.tier)
    share = normalised(score, base)
    return (
        escape(score.tier),
        f"{_format_number(score.return_mean)} ± {_format_number(score.return_std)}",
        DASH if of_base is None else _format_number(of_base.return_mean),
        DASH if share is None else _format_share(share),
        f"{score.length_mean:.0f} steps",
        str(score.episodes),
        escape(score.algorithm if score.tier != RANDOM else "uniform actions"),
        escape(score.origin),
        f"<code>{escape(variant.dataset_id(score.tier))}</code>",
    )


def _render_table(
    caption: str, columns: Sequence[str], rows: Iterable[Sequence[str]], text: Sequence[str] = ("Unit",)
) -> str:
    """Return an HTML table.

    Args:
        caption: caption of the table.
        columns: names of the columns.
        rows: cells of each row. The first cell is the row's header.
        text: names of the columns that contain text. The other columns contain numbers.
    """

    def kind(column: str) -> str:
        return "" if column in text else ' class="number"'

    head = "".join(
        f'<th scope="col"{kind(column) if position else ""}>{column}</th>'
        for position, column in enumerate(columns)
    )
    body = "\n".join(
        "<tr>"
        + f'<th scope="row">{row[0]}</th>'
        + "".join(f"<td{kind(column)}>{cell}</td>" for column, cell in zip(columns[1:], row[1:], strict=True))
        + "</tr>"
        for row in rows
    )
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{caption}"><table>'
        f"<caption>{caption}</caption>"
        f"<thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table></div>"
    )


def _render_code(title: str, text: str, language: str) -> str:
    return (
        f'<section class="code"><h3>{escape(title)} <span class="language">{escape(language)}</span></h3>'
        f'<button type="button" class="button copy" aria-label="Copy: {escape(title)}">Copy</button>'
        f'<pre tabindex="0"><code>{escape(text)}</code></pre></section>'
    )


def _render_neighbour_link(variant: Variant | None, relation: str, label: str) -> str:
    if variant is None:
        return "<span></span>"
    return f'<a rel="{relation}" href="{variant}.html">{label}: {_add_break_points(variant)}</a>'


def _render_legend(variants: Iterable[Variant]) -> str:
    used = {change.category for variant in variants for change in variant.changes}
    names = (
        f'<span class="{name}">{escape(BY_NAME[name].quantity)}</span>' for name in CATEGORIES if name in used
    )
    return f"The colour of a part shows what changes: {', '.join(names)}." if used else ""


def _render_options(values: Iterable[tuple[str, str]]) -> str:
    return "".join(f'<option value="{escape(value)}">{escape(label)}</option>' for value, label in values)


def _format_count(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _add_break_points(variant: Variant) -> str:
    """Return an id as HTML that can break between its parts."""
    return escape(str(variant)).replace("-", "-<wbr>").replace("_", "_<wbr>")


def _format_percent(percent: float) -> str:
    return f"{percent:+.4g}{SPACE}%".replace("-", MINUS)


def _format_change(change: Difference) -> str:
    return DASH if change.before == 0 else _format_percent(100 * (change.after / change.before - 1))


def _format_number(value: float) -> str:
    digits = 0 if abs(value) >= 100 else 1
    return f"{value:,.{digits}f}".replace("-", MINUS)


def _format_share(share: float) -> str:
    # Adding 0 makes a rounded -0 a 0.
    return f"{round(share, 2) + 0:.2f}".replace("-", MINUS)


def _format_normalised(share: float | None) -> str:
    if share is None:
        return ""
    return f' <span class="normalised"><span class="hidden">normalised </span>{_format_share(share)}</span>'


def _format_significant(value: float) -> str:
    return f"{value:.5g}".replace("-", MINUS)


def _load_template(name: str) -> Template:
    return Template((resources.files("imujoco_minari.pictures.gallery") / "site" / name).read_text("utf-8"))
