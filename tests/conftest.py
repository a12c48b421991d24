"""Every test has a Minari root of its own, and none needs the network."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The Minari root of the test: an empty folder that does not exist yet."""
    path = tmp_path / "minari"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(path))
    monkeypatch.delenv("MINARI_REMOTE", raising=False)
    return path


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The test's own folder for policies and training, instead of the user's."""
    path = tmp_path / "imujoco"
    monkeypatch.setenv("IMUJOCO_HOME", str(path))
    return path
