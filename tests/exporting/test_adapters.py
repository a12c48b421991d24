"""Adapters without their libraries: each says what to install. With them, tests/interop does the reading."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import pytest
from synthetic_arrays import synthetic

from imujoco_minari.errors import DependencyError
from imujoco_minari.exporting import adapters


@pytest.mark.parametrize(
    ("adapter", "package"),
    [
        (adapters.to_tianshou, "tianshou"),
        (adapters.to_d3rlpy, "d3rlpy"),
        (adapters.to_tensordict, "tensordict"),
        (adapters.to_torchrl, "torchrl"),
        (adapters.to_imitation, "imitation"),
    ],
)
def test_a_missing_library_is_named(
    adapter: Callable[..., Any], package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(
        DependencyError, match=rf"{adapter.__name__}\(\) needs {package}.*`pip install {package}`"
    ):
        adapter(synthetic([3]))
