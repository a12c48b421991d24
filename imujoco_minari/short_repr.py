"""What the REPL shows of an object with many values: one line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Any


def short_repr(self: Any) -> str:
    """Return one line for a dataclass or a named tuple.

    It leaves out fields that have their default value. An array is shown by its dtype and shape.

    Example:
        >>> short_repr(TransitionBatch(...))  # doctest: +SKIP
        'TransitionBatch(observations=float32 (256, 11), actions=float32 (256, 3), ...)'
    """
    if is_dataclass(self):
        values = {field.name: getattr(self, field.name) for field in fields(self) if field.repr}
        defaults = {field.name: field.default for field in fields(self) if field.default is not MISSING}
    else:
        values, defaults = self._asdict(), self._field_defaults
    shown = (
        f"{name}={_short(value)}"
        for name, value in values.items()
        if name not in defaults or _short(value) != _short(defaults[name])
    )
    return f"{type(self).__name__}({', '.join(shown)})"


def _short(value: Any) -> str:
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        return f"{value.dtype} {tuple(value.shape)}"
    if isinstance(value, float):
        return f"{value:.6g}"
    several = isinstance(value, Mapping) or type(value) in (list, tuple)
    if several and len(value) > 3:
        return f"<{len(value)}: {_short(next(iter(value)))}, ...>"
    shown = repr(dict(value) if isinstance(value, Mapping) else value)
    return shown if len(shown) <= 60 else f"{shown[:30]}...{shown[-27:]}"
