"""The layers of pyproject.toml hold, and the tool that checks them can report a broken one."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
CONFIGURATION = (REPOSITORY / "pyproject.toml").read_text("utf-8")


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    """Run import-linter on the package ``imujoco_minari`` in ``folder``."""
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-logo", "--no-cache"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_no_import_runs_back_up() -> None:
    done = lint(REPOSITORY)
    assert done.returncode == 0, done.stdout
    assert "Contracts: 2 kept, 0 broken." in done.stdout


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A package with the same rooms and the same contracts, and no imports."""
    package = tmp_path / "imujoco_minari"
    contracts = tomllib.loads(CONFIGURATION)["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["id"] == "layers")
    for room in " | ".join(layers).split(" | "):
        (package / room).mkdir(parents=True)
        (package / room / "__init__.py").touch()
    # An allowed importer must exist.
    (package / "cli" / "app.py").touch()
    (package / "__init__.py").touch()
    without_exceptions = re.sub(r"^ignore_imports = \[[^]]*\]\n", "", CONFIGURATION, flags=re.M)
    (tmp_path / "pyproject.toml").write_text(without_exceptions, "utf-8")
    return package


def test_a_package_without_imports_keeps_the_contracts(tiny: Path) -> None:
    done = lint(tiny.parent)
    assert done.returncode == 0, done.stdout
    assert "Analyzed" in done.stdout
    assert "0 dependencies" in done.stdout


@pytest.mark.parametrize(
    ("importer", "line", "report"),
    [
        ("storage", "from imujoco_minari import cli", "imujoco_minari.storage -> imujoco_minari.cli"),
        ("envs", "import imujoco_minari.storage", "imujoco_minari.envs -> imujoco_minari.storage"),
        ("remotes", "import imujoco_minari", "imujoco_minari.remotes -> imujoco_minari (l.1)"),
        ("unlisted", "", "The following modules are not listed as layers:\n\n- imujoco_minari.unlisted"),
    ],
    ids=["back up", "sideways", "of the top level", "of no layer"],
)
def test_an_import_that_breaks_a_contract_is_reported(
    tiny: Path, importer: str, line: str, report: str
) -> None:
    (tiny / importer).mkdir(exist_ok=True)
    (tiny / importer / "__init__.py").write_text(f"{line}\n", "utf-8")
    done = lint(tiny.parent)
    assert done.returncode == 1
    assert report in done.stdout


def test_an_import_back_up_by_way_of_the_top_level_is_reported(tiny: Path) -> None:
    (tiny / "__init__.py").write_text("import imujoco_minari.publishing\n", "utf-8")
    (tiny / "policies" / "__init__.py").write_text("import imujoco_minari\n", "utf-8")
    done = lint(tiny.parent)
    assert done.returncode == 1
    assert "No import runs back up BROKEN" in done.stdout
