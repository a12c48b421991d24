"""Stable-Baselines3 zips, made by hand."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import torch


def good_data() -> dict[str, Any]:
    """The text of ``data``, as far as it is read, in a zip of SAC for Hopper."""
    box = "<class 'gymnasium.spaces.box.Box'>"
    return {
        "policy_class": {"__module__": "stable_baselines3.sac.policies"},
        "policy_kwargs": {},
        "use_sde": False,
        "observation_space": {":type:": box, "_shape": [11]},
        "action_space": {":type:": box, "low": "[-1. -1. -1.]", "high": "[1. 1. 1.]"},
    }


def saved(value: Any) -> bytes:
    """The bytes of a file of ``torch.save``."""
    file = io.BytesIO()
    torch.save(value, file)
    return file.getvalue()


def write_zip(path: Path, pth: bytes, data: dict[str, Any] | None = None) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", json.dumps(good_data() if data is None else data))
        archive.writestr("policy.pth", pth)
    return path
