"""The package as a whole: what it exports, and what importing it costs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from random_actors import random_actor

import imujoco_minari
from imujoco_minari.policies.sb3 import export_zip
from imujoco_minari.variants import Variant

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
