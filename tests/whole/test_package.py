"""The package as a whole: what it exports, and what importing it costs."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import imujoco_minari

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


def test_importing_loads_nothing_heavy() -> None:
    assert not modules_after("import imujoco_minari") & set(HEAVY)


def test_the_test_above_can_fail() -> None:
    assert "mujoco" in modules_after("import imujoco_minari; imujoco_minari.canonical_mjcf")


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
