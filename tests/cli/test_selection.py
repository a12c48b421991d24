"""The filters choose the same variants in every command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import imujoco_minari.cli  # noqa: F401
from imujoco_minari import remotes
from imujoco_minari.cli.app import run
from imujoco_minari.cli.selection import DatasetChoice, Filters, VariantChoice, counted_variants
from imujoco_minari.errors import DatasetNotFoundError, VariantError
from imujoco_minari.pictures.gallery import builder
from imujoco_minari.policies.experts import shipped_folder
from imujoco_minari.publishing import combiner, removal
from imujoco_minari.training import sweep
from imujoco_minari.variants import ROBOTS, Variant, bases, catalogue

HOPPERS = [str(variant) for variant in catalogue("hopper")]
MASS = [str(variant) for variant in catalogue("hopper", "mass")]
LEG = "hopper-massdec_25_leggeom"


@pytest.mark.parametrize(("robot", "count"), [("hopper", 37), ("halfcheetah", 53), ("walker2d", 64)])
def test_a_robot_is_its_variants_and_its_base_on_request(robot: str, count: int) -> None:
    chosen = Filters(robot).variants()
    assert chosen == list(catalogue(robot))
    assert len(chosen) == count
    assert Filters(robot, with_base=True).variants() == [chosen[0].base, *chosen]


def test_all_is_the_catalogue() -> None:
    assert VariantChoice(everything=True).variants() == list(catalogue())
    chosen = VariantChoice(everything=True, with_base=True).variants()
    assert len(chosen) == 157
    # Each robot's base comes before its variants.
    assert [variant for variant in chosen if variant in bases()] == list(bases())
    assert [chosen[0].robot, chosen[38].robot] == list(ROBOTS[:2])


def test_names_are_taken_once_and_not_with_filters() -> None:
    chosen = VariantChoice(names=[LEG, "hopper-base", LEG]).variants()
    assert chosen == [Variant.parse(LEG), Variant.parse("hopper-base")]
    for choice in (VariantChoice("hopper", names=[LEG]), VariantChoice(with_base=True, names=[LEG])):
        with pytest.raises(VariantError, match="not both"):
            choice.variants()
    with pytest.raises(VariantError, match="name a variant, or choose some"):
        VariantChoice().variants()
    with pytest.raises(VariantError, match="not both"):
        DatasetChoice(ids=["a/b-v0"], tiers=["random"]).datasets()


def test_datasets_are_those_of_each_tier(root: Path) -> None:
    ids = DatasetChoice("hopper", "mass", tiers=["expert", "random"]).datasets(published=False)
    assert ids == [f"imujoco/{name}{tier}-v0" for tier in ("", "-random") for name in MASS]
    with pytest.raises(
        DatasetNotFoundError,
        match="make them with `imujoco publish --robot hopper --category mass --tier random`",
    ):
        DatasetChoice("hopper", "mass", tiers=["random"]).datasets()
    (root / ids[0]).mkdir(parents=True)
    assert DatasetChoice("hopper").datasets() == [ids[0]]


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ([LEG], "1 variant"),
        ([LEG, "hopper-base"], "1 variant and 1 base"),
        (["hopper-base", "walker2d-base"], "0 variants and 2 bases"),
    ],
)
def test_counts_are_right_in_words(names: list[str], words: str) -> None:
    assert counted_variants([Variant.parse(name) for name in names]) == words


class StopError(Exception):
    """Ends a command when it knows what to work on."""


@pytest.fixture
def chosen(root: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What a command chose, as names of variants. Every Hopper is published, as an empty folder."""
    found: list[str] = []

    def take(items: Any, *_: Any, **__: Any) -> Any:
        found.extend(str(item).removeprefix("imujoco/").removesuffix("-v0") for item in items)
        raise StopError

    for name in [*HOPPERS, "hopper-base"]:
        (root / "imujoco" / f"{name}-v0").mkdir(parents=True)
    monkeypatch.setattr(remotes, "push_all", take)
    monkeypatch.setattr(remotes, "pull_all", take)
    monkeypatch.setattr(removal, "delete", take)
    monkeypatch.setattr(combiner, "combine_datasets", take)
    monkeypatch.setattr(sweep, "train_all", take)
    monkeypatch.setattr(builder, "build", lambda folder, variants, **_: take(variants))
    return found


COMMANDS = {
    "push": ["--remote", "gcp://bucket"],
    "pull": ["--remote", "gcp://bucket"],
    "delete": ["--yes"],
    "combine": ["--id", "imujoco/hopper-mine-v0"],
    "train": [],
    "gallery": ["site"],
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_works_on_the_variants_that_the_filters_choose(
    name: str, chosen: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    cases = {(): HOPPERS, ("--category", "mass"): MASS}
    if name != "gallery":
        cases[("--with-base",)] = ["hopper-base", *HOPPERS]
    for extra, expected in cases.items():
        chosen.clear()
        with pytest.raises(StopError):
            run([name, *COMMANDS[name], "--robot", "hopper", *extra])
        assert chosen == expected


@pytest.mark.parametrize("name", ["list", "policies", "publish", "verify"])
def test_a_command_lists_the_variants_that_the_filters_choose(
    name: str, chosen: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    extra = {"publish": ["--dry-run"], "verify": ["--no-replay"]}.get(name, [])
    cases: dict[tuple[str, ...], list[str]] = {
        ("--category", "friction"): [str(v) for v in catalogue("hopper", "friction")],
        ("--category", "friction", "--with-base"): [
            "hopper-base",
            *map(str, catalogue("hopper", "friction")),
        ],
    }
    for filters, expected in cases.items():
        run([name, "--robot", "hopper", *filters, *extra, "--json"])
        shown = json.loads(capsys.readouterr().out)
        ids = (
            [row.get("variant") or row["dataset_id"] for row in shown]
            if isinstance(shown, list)
            else list(shown)
        )
        names = [each.removeprefix("imujoco/").removesuffix("-v0") for each in ids]
        assert names == expected


def test_policies_without_filters_are_all_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["policies", "--json"]) == 0
    shown = {record["variant"] for record in json.loads(capsys.readouterr().out)}
    names = {path.stem for path in shipped_folder().glob("*-*.json")}
    own = {name for name in names if not name.endswith((".agent", "-universal"))}
    # Those of targets of off-dynamics learning have experts of their own, but are not in the catalogue.
    assert own - {str(variant) for variant in (*catalogue(), *bases())}
    assert shown == own | {str(variant) for variant in (*catalogue(), *bases())}
    assert run(["policies", "--all"]) == 2
    capsys.readouterr()
    assert run(["policies", "--summary", "--robot", "hopper", "--json"]) == 0
    assert [(line["robot"], line["category"]) for line in json.loads(capsys.readouterr().out)] == [
        ("hopper", category) for category in ("mass", "joint", "length", "friction")
    ]


def test_publish_takes_several_tiers(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["publish", LEG, "-t", "random", "-t", "medium", "-t", "random", "-n", "1"]
    assert run([*arguments, "--json"]) == 0
    ids = [outcome["dataset_id"] for outcome in json.loads(capsys.readouterr().out)]
    assert ids == [f"imujoco/{LEG}-random-v0", f"imujoco/{LEG}-medium-v0"]
    assert run(["list", "-r", "hopper", "-c", "mass"]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith(LEG)]
    assert line.endswith("  own     medium, random")
    assert run(["show", LEG]) == 0
    assert "(published here: medium, random)" in capsys.readouterr().out


def test_the_default_id_of_a_collection_is_not_for_the_base(
    chosen: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["combine", "--robot", "hopper", "--with-base"]) == 2
    assert "name the collection with --id" in capsys.readouterr().err
    assert run(["combine", "--category", "mass"]) == 2
    assert chosen == []
