"""The pages that are written from the code say what the code says."""

from __future__ import annotations

import json
import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType

import pytest

from imujoco_minari.policies.experts import shipped_folder
from imujoco_minari.policies.tiers import medium_rung
from imujoco_minari.variants import ROBOTS, catalogue
from imujoco_minari.variants.off_dynamics import off_dynamics, off_dynamics_names

SCRIPT = Path(__file__).parents[2] / "scripts" / "generate-docs"


@pytest.fixture(scope="module")
def generator() -> ModuleType:
    """The script as a module."""
    loader = SourceFileLoader("generate_docs", str(SCRIPT))
    module = module_from_spec(spec_from_loader("generate_docs", loader))
    # The byte code would be written beside the script.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "dont_write_bytecode", True)
        loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def pages(generator: ModuleType) -> dict[str, str]:
    """The pages as the script writes them now."""
    return {name: write() for name, write in generator.PAGES.items()}


def test_every_page_is_current(generator: ModuleType, pages: dict[str, str]) -> None:
    stale = [name for name, page in pages.items() if (generator.DOCS / name).read_text("utf-8") != page]
    assert len(pages) == 5
    assert stale == [], "run scripts/generate-docs"


def test_every_shipped_expert_has_its_row(pages: dict[str, str]) -> None:
    rows = [line for line in pages["experts.md"].splitlines() if line.startswith("| `")]
    names = {path.stem for path in shipped_folder().glob("*-*.json")}
    shipped = {name for name in names if not name.endswith((".agent", "-universal"))}
    targets = {str(off_dynamics(name).target) for robot in ROBOTS for name in off_dynamics_names(robot)}
    assert {row.split("`")[1] for row in rows} == shipped | targets
    folded = {row.split("`")[1] for row in rows if "`universal policy`" in row}
    assert folded >= targets - shipped


def test_the_universal_policies_rows_are_those_of_their_records(pages: dict[str, str]) -> None:
    for robot in ROBOTS:
        measured = json.loads((shipped_folder() / f"{robot}-universal.json").read_text("utf-8"))["measured"]
        base = json.loads((shipped_folder() / f"{robot}-base.json").read_text("utf-8"))["evaluation"]
        returns = [measured[str(each)]["evaluation"]["return_mean"] for each in catalogue(robot)]
        shares = sorted(each / base["return_mean"] for each in returns)
        row = [f"{len(shares)}", f"{shares[len(shares) // 2]:.2f}", f"{shares[0]:.2f}"]
        (line,) = (line for line in pages["experts.md"].splitlines() if line.startswith(f"| {robot} | all |"))
        cells = line.split(" | ")
        assert cells[2] == row[0]
        assert abs(float(cells[3]) - float(row[1])) <= 0.01
        assert cells[4] == row[2]
        # All episodes of a base's expert have the full length.
        lengths = [measured[str(each)]["evaluation"]["length_mean"] for each in catalogue(robot)]
        assert cells[8].removesuffix(" |") == str(sum(length < 1000 for length in lengths))


def test_every_variant_has_its_row(pages: dict[str, str]) -> None:
    rows = [line for line in pages["variants.md"].splitlines() if line.startswith("| `")]
    assert [row.split("`")[1] for row in rows] == [str(variant) for variant in catalogue()]


def test_the_references_of_the_bases_are_those_of_their_records(generator: ModuleType) -> None:
    page = (generator.DOCS / "from-d4rl.md").read_text("utf-8")
    for base in ("hopper-base", "halfcheetah-base", "walker2d-base"):
        record = json.loads((shipped_folder() / f"{base}.json").read_text("utf-8"))
        expert, random = record["evaluation"], record["random"]
        medium = medium_rung(record["ladder"], record)["evaluation"]
        measured = (
            f"{each['return_mean']:.1f} ± {each['return_std']:.1f}" for each in (random, medium, expert)
        )
        assert f"| `{base}` | {' | '.join(measured)} |\n" in page


def test_a_stale_page_is_named(
    generator: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generator, "DOCS", tmp_path)
    monkeypatch.setattr(generator, "PAGES", {f"{name}.md": lambda: "new" for name in "abc"})
    monkeypatch.setattr(sys, "argv", [SCRIPT.name, "--check"])
    (tmp_path / "a.md").write_text("old", "utf-8")
    (tmp_path / "b.md").write_text("new", "utf-8")
    with pytest.raises(SystemExit, match=r"^not current: docs/a\.md, docs/c\.md; run scripts/generate-docs$"):
        generator.main()
    assert (tmp_path / "a.md").read_text("utf-8") == "old"
    assert not (tmp_path / "c.md").exists()
    monkeypatch.setattr(sys, "argv", [SCRIPT.name])
    generator.main()
    assert {path.name: path.read_text("utf-8") for path in tmp_path.iterdir()} == dict.fromkeys(
        generator.PAGES, "new"
    )
