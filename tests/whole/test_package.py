"""The package as a whole: what it exports, and what importing it costs."""

from __future__ import annotations

import subprocess
import sys

import pytest

import imujoco_minari

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
