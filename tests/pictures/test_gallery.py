"""The gallery as files: what its pages hold, where they lead, what a second run draws again."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import h5py
import minari
import pytest

from imujoco_minari import publish
from imujoco_minari.cli.app import run
from imujoco_minari.envs import gl
from imujoco_minari.envs.differences import differences
from imujoco_minari.errors import DependencyError, PolicyError, RenderingError, StorageError
from imujoco_minari.pictures.gallery import build, clips, entries
from imujoco_minari.pictures.gallery.pages import short, snippets, summary
from imujoco_minari.pictures.rendering.scene import COLOURS
from imujoco_minari.pictures.rendering.studio import Studio
from imujoco_minari.policies import RandomPolicy, experts, policies_folder, references
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.variants import Variant, catalogue

# What the pages say follows from what a test publishes and trains, not from what is shipped today.
pytestmark = pytest.mark.usefixtures("unshipped")

LEG = Variant.parse("hopper-massdec_25_leggeom")
FOOT = Variant.parse("hopper-lengthinc_50_footgeom")
VOID = {"meta", "link", "img", "input", "wbr", "source", "br"}


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Stubs in the place of clips and portraits, for machines without OpenGL; names what was drawn."""
    names: list[str] = []

    def write_clip(motion: Any, studio: Studio, path: Path) -> None:
        path.parent.mkdir(exist_ok=True, parents=True)
        path.write_bytes(b"clip")
        names.append(str(motion.variant))

    def write_portrait(variant: Variant, studio: Studio, path: Path) -> None:
        path.parent.mkdir(exist_ok=True, parents=True)
        path.write_bytes(b"portrait")

    monkeypatch.setattr(clips, "write_clip", write_clip)
    monkeypatch.setattr(clips, "write_portrait", write_portrait)
    return names


@pytest.fixture
def folder(tmp_path: Path, drawn: list[str]) -> Path:
    """A folder for a site whose pictures are stubs."""
    return tmp_path / "site"


class Page(HTMLParser):
    """An HTML page, its tags balanced, as the tests look at it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(path.read_text("utf-8"))
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", "".join(self.words))

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attrs for name, attrs in self.tags if name == tag]


def cards(folder: Path) -> dict[str, dict[str, str | None]]:
    """Return the cards of the index by their variants."""
    found = [attrs for attrs in Page(folder / "index.html").all("li") if "data-words" in attrs]
    return {attrs["data-words"].split()[0]: attrs for attrs in found}


def site(folder: Path) -> list[Path]:
    return [folder / "index.html", *sorted((folder / "variants").glob("*.html"))]


def test_every_variant_has_a_card_and_a_page_and_every_link_leads_somewhere(folder: Path) -> None:
    chosen = catalogue("hopper", "length")
    built = build(folder, chosen)
    assert (built.variants, built.drawn, built.failed) == (9, 9, {})
    assert len(cards(folder)) == 9
    links = [attrs["href"] for attrs in Page(folder / "index.html").all("a")]
    assert [link for link in links if link.startswith("variants/")] == [
        f"variants/{variant}.html" for variant in (LEG.base, *chosen)
    ]
    for path in site(folder):
        page = Page(path)
        for tag, attribute in (
            ("a", "href"),
            ("img", "src"),
            ("link", "href"),
            ("script", "src"),
            ("source", "src"),
        ):
            for attrs in page.all(tag):
                target = attrs[attribute]
                if target.startswith("#"):
                    assert target[1:] in [attrs.get("id") for _, attrs in page.tags]
                elif not target.startswith("data:"):
                    assert (path.parent / target).is_file(), target


def test_nothing_is_fetched_from_anywhere_else(folder: Path) -> None:
    build(folder, [LEG])
    for path in folder.rglob("*"):
        if path.suffix in (".html", ".css", ".js"):
            assert not re.search(r"(https?:)?//\w|@import|fetch\(|XMLHttp", path.read_text("utf-8")), path


def test_the_pages_can_be_used_without_a_mouse_or_eyes(folder: Path) -> None:
    build(folder, [LEG])
    for path in site(folder):
        page = Page(path)
        assert page.all("html") == [{"lang": "en"}]
        assert len(page.all("h1")) == len(page.all("main")) == 1
        identifiers = [attrs["id"] for _, attrs in page.tags if "id" in attrs]
        assert len(identifiers) == len(set(identifiers))
        assert all("alt" in attrs for attrs in page.all("img"))
        assert all(attrs["aria-label"] for attrs in page.all("video"))
        assert all("controls" in attrs and "autoplay" not in attrs for attrs in page.all("video"))
        assert all(attrs.get("scope") for attrs in page.all("th"))
        for attrs in page.all("section"):
            assert attrs.get("aria-labelledby", "use") in identifiers
    index = (folder / "index.html").read_text("utf-8")
    controls = re.findall(r"<label>[^<]+<(input|select)", index)
    assert len(controls) == len(re.findall(r"<(?:input|select)\b", index)) == 6
    assert 'aria-live="polite"' in index


def test_a_page_tells_the_numbers_before_and_after(folder: Path) -> None:
    build(folder, [FOOT])
    text = Page(folder / "variants" / f"{FOOT}.html").text
    found = differences(FOOT)
    assert found
    for difference in found:
        assert difference.quantity in text
        assert f"{difference.before:.5g}" in text
        assert f"{difference.after:.5g}" in text
    assert "It has no expert policy yet" in text
    assert "measured for this page" in text
    base = Page(folder / "variants" / "hopper-base.html")
    assert "the robot of Gymnasium’s v5 environment" in base.text  # noqa: RUF001
    assert len(base.all("video")) == 1


def test_an_experts_record_is_told_and_sorted_by(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    evaluation = {"return_mean": 3183.5, "return_std": 12.0, "length_mean": 1000.0, "episodes": 100}
    random = {"return_mean": 18.25, "return_std": 3.0, "length_mean": 22.0, "episodes": 100}
    record = {"algorithm": "TQC", "evaluation": evaluation, "random": random}
    monkeypatch.setattr(entries, "measured_record", lambda variant: record if variant == LEG else {})
    monkeypatch.setattr(
        clips, "choose_policy", lambda variant: (RandomPolicy(3), "expert" if variant == LEG else "random")
    )
    build(folder, [LEG])
    assert cards(folder)[str(LEG)]["data-return"] == "3183.5"
    text = Page(folder / "variants" / f"{LEG}.html").text
    assert "3,184 ± 12.0" in text or "3,183 ± 12.0" in text
    assert "18.2 ± 3.0" in text
    assert "its expert policy" in text
    assert f"imujoco publish {LEG} --tier" not in text


def test_an_expert_that_was_not_measured_yet_is_measured_for_its_page(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def two_episodes(variant: Variant, policy: Any, seed: int) -> dict[str, Any]:
        return evaluate(variant, policy, episodes=2, seed=seed).asdict()

    policies_folder().mkdir(parents=True)
    for ending in ("json", "safetensors"):
        shutil.copy(experts.shipped_folder() / f"hopper-universal.{ending}", policies_folder())
    monkeypatch.setattr(references, "_evaluation", two_episodes)
    expert, random = entries.scores(Variant.parse("hopper-massinc_37p25_torsogeom"))
    assert (expert.tier, expert.episodes) == ("expert", 2)
    assert (random.tier, random.episodes) == ("random", 2)
    assert expert.return_mean > 50 * random.return_mean > 0


def test_cards_state_scores_normalised_by_the_base(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def record(variant: Variant) -> dict[str, Any]:
        expert = {LEG: 500.0, LEG.base: 2020.0}.get(variant)
        rest = {"return_std": 1.0, "length_mean": 50.0, "episodes": 100}
        evaluation = {} if expert is None else {"evaluation": {"return_mean": expert, **rest}}
        return {"algorithm": "SAC", "random": {"return_mean": 20.0, **rest}, **evaluation}

    monkeypatch.setattr(entries, "measured_record", record)
    build(folder, [LEG, FOOT])
    # (500 - 20) / (2020 - 20), and the random policy of the variant without an expert.
    expected = {"hopper-base": "1", str(LEG): "0.24", str(FOOT): "0"}
    assert {name: card["data-normalised"] for name, card in cards(folder).items()} == expected
    assert "2 of 2 variants, 1 of 1 bases" in Page(folder / "index.html").text
    assert "0.24" in Page(folder / "variants" / f"{LEG}.html").text


def test_a_page_has_its_neighbours_above_and_below(folder: Path) -> None:
    build(folder, [LEG, FOOT])
    page = Page(folder / "variants" / f"{LEG}.html")
    links = [(link["rel"], link["href"]) for link in page.all("a") if "rel" in link]
    assert links == [("prev", "hopper-base.html"), ("next", f"{FOOT}.html")] * 2
    heading = (folder / "variants" / f"{LEG}.html").read_text("utf-8")
    assert "hopper-<wbr>massdec_<wbr>25_<wbr>leggeom</h1>" in heading


def test_datasets_that_are_published_here_are_told() -> None:
    published = publish(LEG, tier="random", episodes=3)
    publish(FOOT, tier="random", episodes=2)
    (score,) = entries.scores(LEG)
    assert (score.tier, score.episodes, score.origin) == ("random", 3, "the published dataset")
    assert score.return_mean == pytest.approx(published.return_mean)
    assert score.return_std == pytest.approx(published.return_std)


def damage_file(data: Path) -> None:
    (data / "main_data.hdf5").write_bytes(b"broken")


def damage_group(data: Path) -> None:
    # The signature of a group's nodes. HDF5 fails with a RuntimeError.
    damaged = (data / "main_data.hdf5").read_bytes().replace(b"SNOD", b"SNOB")
    (data / "main_data.hdf5").write_bytes(damaged)


def damage_metadata(data: Path) -> None:
    (data / "metadata.json").write_text("[]")


def drop_episodes(data: Path) -> None:
    with h5py.File(data / "main_data.hdf5", "a") as file:
        file.clear()


def link_elsewhere(data: Path) -> None:
    outside = data.parents[3] / "main_data.hdf5"
    shutil.copyfile(data / "main_data.hdf5", outside)
    with h5py.File(data / "main_data.hdf5", "a") as file:
        del file["episode_0"]
        file["episode_0"] = h5py.ExternalLink(outside, "episode_0")


@pytest.mark.parametrize(
    "damage", [damage_file, damage_group, damage_metadata, drop_episodes, link_elsewhere]
)
def test_a_damaged_dataset_is_not_told(damage: Callable[[Path], None]) -> None:
    data = publish(LEG, tier="random", episodes=2).path / "data"
    (score,) = entries.scores(LEG)
    assert score.origin == "the published dataset"
    damage(data)
    (score,) = entries.scores(LEG)
    assert score.origin == "measured for this page"


@pytest.mark.parametrize("name", [str(LEG), "hopper-massinc_50_torsogeom-frictiondec_50_feet"])
def test_the_lines_of_code_run(tmp_path: Path, name: str) -> None:
    variant = Variant.parse(name)
    entry = entries.Entry(variant, (), entries.scores(variant), entries.Clip("random", 0.2, 10.0, True))
    (_, shell, _), *pythons = snippets(entry)
    assert shell.startswith("imujoco publish ")
    assert run([*shell.split()[1:], "--episodes", "5"]) == 0
    assert len(pythons) == 2
    for _, text, language in pythons:
        assert language == "Python"
        scope: dict[str, Any] = {}
        exec(text, scope)
        if "dataset" in scope:
            assert isinstance(scope["dataset"], minari.MinariDataset)
            assert len(list(scope["episodes"])) == 5
        else:
            assert scope["observation"].shape == (11,)
            scope["env"].close()


@pytest.mark.parametrize(
    ("name", "brief", "sentence"),
    [
        ("hopper-base", "unchanged", "Hopper (Hopper-v5), unchanged"),
        ("hopper-massdec_25_leggeom", "mass of leggeom −25 %", "the mass of leg_geom changed by −25 %"),  # noqa: RUF001
        ("hopper-massinc_1234p56_leggeom", "mass of leggeom +1234.56 %", "changed by +1234.56 %"),
        ("walker2d-jointdec_50_legjoint", "range of legjoint −50 %", "the range of motion of leg_joint"),  # noqa: RUF001
    ],
)
def test_a_variant_in_words(name: str, brief: str, sentence: str) -> None:
    variant = Variant.parse(name)
    assert short(variant).replace("\xa0", " ") == brief
    assert sentence in summary(variant).replace("\xa0", " ")


# Runs after the first


def test_a_second_run_draws_nothing_and_needs_no_opengl(
    folder: Path, drawn: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = build(folder, [LEG])
    pages = {path: path.read_bytes() for path in site(folder)}
    monkeypatch.setattr(Studio, "context", property(lambda self: pytest.fail("drew")))
    second = build(folder, [LEG])
    assert (first.drawn, second.drawn) == (2, 0)
    assert drawn == ["hopper-base", str(LEG)]
    assert {path: path.read_bytes() for path in site(folder)} == pages


def test_a_run_that_was_broken_off_goes_on(folder: Path, drawn: list[str]) -> None:
    chosen = catalogue("hopper", "friction")

    def stop_after(count: int) -> Callable[[], None]:
        def advance() -> None:
            if len(drawn) == count:
                raise KeyboardInterrupt

        return advance

    with pytest.raises(KeyboardInterrupt):
        build(folder, chosen, on_variant=stop_after(2))
    assert not (folder / "index.html").exists()
    assert build(folder, chosen).drawn == 2
    assert len(drawn) == len(set(drawn)) == 4


def test_what_has_changed_or_is_gone_is_drawn_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build(folder, [LEG])
    (folder / "clips" / f"{LEG}.mp4").unlink()
    assert build(folder, [LEG]).drawn == 1
    (folder / "portraits" / f"{LEG.base}.webp").unlink()
    assert build(folder, [LEG]).drawn == 1
    monkeypatch.setattr(clips, "STYLE", 0)
    assert build(folder, [LEG]).drawn == 2


def test_a_site_keeps_the_variants_that_it_has(folder: Path) -> None:
    build(folder, [FOOT])
    built = build(folder, [LEG])
    assert (built.variants, built.drawn) == (3, 1)
    names = [path.stem for path in site(folder)[1:]]
    assert names == sorted(["hopper-base", str(LEG), str(FOOT)])


def test_a_variant_outside_the_catalogue_can_be_shown(folder: Path) -> None:
    variant = Variant.parse("hopper-massinc_37_torsogeom")
    assert build(folder, [variant]).variants == 2
    assert "+37" in (folder / "index.html").read_text("utf-8")


def test_a_folder_of_someone_elses_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(StorageError, match="not a gallery and not empty"):
        build(tmp_path, [LEG])
    (tmp_path / "gallery.json").write_text("{}")
    with pytest.raises(StorageError, match=r"gallery\.json has another format than this version writes"):
        build(tmp_path, [LEG])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["gallery.json", "thesis.tex"]


def test_a_variant_that_fails_is_named_and_the_others_are_shown(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    choose = clips.choose_policy

    def broken(variant: Variant) -> Any:
        if variant == LEG:
            raise PolicyError("the weights are torn")
        return choose(variant)

    monkeypatch.setattr(clips, "choose_policy", broken)
    assert run(["gallery", str(folder), str(LEG), str(FOOT), "--json"]) == 1
    told = capsys.readouterr()
    assert f"{LEG}: the weights are torn" in told.err
    assert json.loads(told.out)["failed"] == {str(LEG): "the weights are torn"}
    index = (folder / "index.html").read_text("utf-8")
    assert str(FOOT) in index
    assert str(LEG) not in index


def test_a_site_of_which_every_variant_failed_can_be_continued(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(variant: Variant) -> Any:
        raise PolicyError("the weights are torn")

    with monkeypatch.context() as patch:
        patch.setattr(clips, "choose_policy", broken)
        assert run(["gallery", str(folder), str(LEG)]) == 1
    assert run(["gallery", str(folder), str(LEG)]) == 0
    assert str(LEG) in (folder / "index.html").read_text("utf-8")


def test_the_first_page_names_the_robots_and_the_colours_that_it_shows(folder: Path) -> None:
    build(folder, [FOOT, Variant.parse("ant-gearinc_50_hip1-dampingdec_50_hip1")])
    index = (folder / "index.html").read_text("utf-8")
    assert "2 variants and 2 base robots of Hopper and Ant. With an expert policy: 0." in index
    legend = re.findall(
        r'<span class="(\w+)">([^<]+)</span>', index[index.index("<header") : index.index("</header")]
    )
    assert legend == [
        ("length", "length"),
        ("gear", "strength of the motor"),
        ("damping", "damping"),
    ]
    style = (folder / "style.css").read_text("utf-8")
    assert all(f".{name} {{ color: var(--{name}); }}" in style for name in COLOURS)


def test_without_opengl_nothing_is_half_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_context(self: Studio) -> Any:
        raise RenderingError("no OpenGL for off-screen rendering")

    monkeypatch.setattr(Studio, "context", property(no_context))
    assert run(["gallery", str(tmp_path / "site"), str(LEG)]) == 1
    assert "no OpenGL" in capsys.readouterr().err
    assert not (tmp_path / "site" / "index.html").exists()


def test_a_missing_video_writer_is_told_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(DependencyError, match=r"imujoco-minari\[render\]"):
        build(tmp_path / "site", [LEG])


def test_the_command_takes_the_filters_of_list(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["gallery", str(folder), "--robot", "hopper", "--category", "friction"]
    assert run(arguments) == 0
    assert "4 variants and bases, 4 drawn anew" in capsys.readouterr().out
    assert run([*arguments[:2], "--robot", "hoper"]) == 2
    assert "did you mean 'hopper'" in capsys.readouterr().err


def test_few_shot_scores_stand_on_the_pages_of_their_variants(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = {
        "method": "mine",
        "tier": "expert",
        "split": "hopper-extremes-v1",
        "budget": "5x100",
        "protocol": "few-shot-v1",
        "settings": {},
        "versions": {},
        "data_sha256": "",
        "train_sha256": "",
        "policies_sha256": "",
    }
    returns = {"0": {"returns": [100.0, 200.0], "error": 1.0}, "25": {"returns": [300.0], "error": 1.0}}
    lines = [
        cell | {"variant": str(LEG), "seed": seed, "references": [0.0, 1000.0], "results": returns}
        for seed in (0, 1)
    ]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (tmp_path / "few-shot.jsonl").write_text(text, "utf-8")
    arguments = ["gallery", str(folder), str(LEG), str(FOOT), "--results"]
    assert run([*arguments, str(tmp_path)]) == 0
    text = (folder / "variants" / f"{LEG}.html").read_text("utf-8")
    assert "<caption>hopper-extremes-v1, expert</caption>" in text
    rows = re.findall(r'<th scope="row">mine</th><td.*?>(\d+)</td><td.*?>(.*?)</td>', text)
    assert rows == [("0", "0.15 (0.15 to 0.15)"), ("25", "0.30 (0.30 to 0.30)")]
    assert "Few-shot" not in Page(folder / "variants" / f"{FOOT}.html").text
    capsys.readouterr()
    assert run([*arguments, str(tmp_path / "nowhere")]) == 1
    assert "nowhere has no results: `imujoco benchmark few-shot` computes some" in capsys.readouterr().err


# The pictures themselves


def test_clips_and_portraits_are_drawn_and_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    # Set first, so that what the choice of a backend writes is undone.
    monkeypatch.setenv("MUJOCO_GL", "")
    try:
        gl.backend()
    except RenderingError as error:
        pytest.skip(str(error))
    folder = tmp_path / "site"
    assert build(folder, [LEG]).drawn == 2
    clip = folder / "clips" / f"{LEG}.mp4"
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(clip))
    assert frames >= 20
    # The episode ends within a moment, and its end stands for a second.
    assert 1.0 < seconds < 3.0
    assert clip.stat().st_size < 100_000
    assert 500 < (folder / "portraits" / f"{LEG}.webp").stat().st_size < 20_000
