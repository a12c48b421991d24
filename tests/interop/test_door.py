"""The library's page of the documentation runs to its end."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from doc_blocks import REPOSITORY, read_page, run_page


def test_every_block_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, library = (os.environ.get(f"IMUJOCO_INTEROP_{name}") for name in ("DATA", "LIBRARY"))
    if folder is None or library is None:
        pytest.skip("run by scripts/test-interop, which makes the data")
    if library == "lerobot":
        from cpu_torchvision import import_torchvision

        import_torchvision()
    page = read_page(REPOSITORY / "docs" / "doors" / f"{library}.md")
    monkeypatch.setenv("MINARI_DATASETS_PATH", f"{folder}/root")
    monkeypatch.chdir(tmp_path)
    assert run_page(page) == list(page.blocks)
