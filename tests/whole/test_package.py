"""The package as a whole: what it exports, and what importing it costs."""

from __future__ import annotations

import ast
import os
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest
from random_actors import random_actor

import imujoco_minari
from imujoco_minari.policies.sb3 import export_zip
from imujoco_minari.variants import Variant

REPOSITORY = Path(__file__).parents[2]
HEAVY = ("torch", "jax", "minari", "mujoco", "h5py", "stable_baselines3", "typer")


def modules_after(code: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-c", f"import sys\n{code}\nprint(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stdout.split())


def test_dir_lists_public_names_only() -> None:
    for module in (imujoco_minari, imujoco_minari.envs):
        names = [name for name in dir(module) if not name.startswith("__")]
        assert set(module.__all__) <= set(names)
        assert not {"Any", "TYPE_CHECKING", "annotations", "import_module", "_LAZY"} & set(names)
        assert all(hasattr(module, name) for name in dir(module))


def test_importing_loads_nothing_heavy() -> None:
    assert not modules_after("import imujoco_minari") & set(HEAVY)


def test_the_command_line_starts_with_nothing_heavy_but_its_parser() -> None:
    assert modules_after("import imujoco_minari.cli") & set(HEAVY) == {"typer"}


def test_the_tests_above_can_fail() -> None:
    assert "mujoco" in modules_after("import imujoco_minari; imujoco_minari.canonical_mjcf")


def test_publishing_by_a_policy_in_safetensors_does_not_load_torch() -> None:
    loaded = modules_after(
        "from imujoco_minari.publishing.publisher import publish\n"
        "from imujoco_minari.variants import Variant\n"
        "publish(Variant.parse('hopper-base'), tier='medium', episodes=1)"
    )
    assert "mujoco" in loaded
    assert not loaded & {"torch", "stable_baselines3", "jax"}


def test_reading_a_zip_loads_torch_in_a_child_process_only(tmp_path: Path) -> None:
    path = export_zip(Variant.parse("hopper-base"), tmp_path / "a.zip", random_actor())
    loaded = modules_after(f"import imujoco_minari.policies as p; p.read_actor({str(path)!r})")
    assert "numpy" in loaded
    assert not loaded & {"torch", "stable_baselines3"}


def test_what_is_exported_exists_and_is_documented() -> None:
    for name in imujoco_minari.__all__:
        assert getattr(imujoco_minari, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = imujoco_minari.nothing


def test_pre_commit_runs_the_quick_checks() -> None:
    hooks = (REPOSITORY / ".pre-commit-config.yaml").read_text("utf-8")
    checks = (REPOSITORY / "scripts" / "check").read_text("utf-8")
    quick = re.findall(r"^(?:ruff|lint-imports|mypy)\b.*$", checks, re.M)
    assert len(quick) == 4
    assert re.findall(r"entry: \.venv/bin/(.*)", hooks) == quick


def missing_imports(source: str) -> list[str]:
    """Return the names that a script imports from this repository's packages and that do not exist."""
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module:
            names += [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
    return [name for name in names if name.startswith(("imujoco_minari", "scripts")) and not exists(name)]


def exists(name: str) -> bool:
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True


def is_python(path: Path) -> bool:
    if path.suffix or not path.is_file():
        return path.suffix == ".py"
    return path.read_text("utf-8").startswith("#!/usr/bin/env python")


SCRIPTS = [
    path
    for folder in ("scripts", "tests/campaigns", "tests/interop")
    for path in sorted((REPOSITORY / folder).rglob("*"))
    if is_python(path)
]


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_what_a_script_imports_exists(path: Path) -> None:
    """The suite runs no benchmark and no campaign, so nothing else notices a module that moved."""
    assert missing_imports(path.read_text("utf-8")) == []


def test_a_missing_import_is_found() -> None:
    source = "import imujoco_minari.nothing\ndef f():\n    from imujoco_minari.envs import nothing, make\n"
    assert missing_imports(source) == ["imujoco_minari.nothing", "imujoco_minari.envs.nothing"]
    assert "generate-docs" in [path.name for path in SCRIPTS]


def test_a_script_beside_the_clone_imports_the_package(tmp_path: Path) -> None:
    (tmp_path / "imujoco_minari").mkdir()  # as the clone's own folder
    (tmp_path / "script.py").write_text("import imujoco_minari; print(imujoco_minari.load_policy.__module__)")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    shown = subprocess.check_output([sys.executable, "script.py"], cwd=tmp_path, env=environment, text=True)
    assert shown.startswith("imujoco_minari.")
