"""Reads the JSON records beside policies. They may come from elsewhere, so their values are checked."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from imujoco_minari.errors import PolicyError, clipped
from imujoco_minari.variants import Variant

# A record with a ladder and its history has 7 kB.
_MAX_BYTES = 2**22
_MAX_HISTORY = 100
EVALUATION = ("episodes", "return_mean", "return_std", "return_min", "return_max", "length_mean")


def read_own_record(path: Path, variant: Variant) -> dict[str, Any]:
    """Return the training record of a variant's own expert.

    Raises:
        PolicyError: if the file holds no such record.
    """
    with errors_of(path):
        record = read_object(path)
        if record.get("variant") != str(variant):
            raise ValueError(f"its variant is {clipped(repr(record.get('variant')))}")
        if "universal_sha256" in record:
            raise ValueError("universal_sha256 belongs to folded policies")
        for key in ("algorithm", "start", "weights_sha256"):
            if not isinstance(record[key], str):
                raise ValueError(f"{key} must be a text")
        _check_number(record["steps"], "steps", whole=True)
        _check_seconds(record)
        _check_evaluation(record["evaluation"], "evaluation")
        check_measured(record)
    return record


def read_measured(path: Path) -> dict[str, Any]:
    """Return the evaluations of an expert that were kept beside the user's policies.

    Raises:
        PolicyError: if the file holds no such evaluations.
    """
    with errors_of(path):
        measured = read_object(path)
        check_measured(measured)
    return measured


def check_measured(measured: Any) -> None:
    """Check the evaluations of a record and of its ladder, as far as it states them.

    Raises:
        ValueError: if one of them is none.
    """
    if not isinstance(measured, Mapping):
        raise ValueError("the evaluations must be a table")
    for key in ("evaluation", "random"):
        if key in measured:
            _check_evaluation(measured[key], key)
    for rung in measured.get("ladder", []):
        _check_number(rung["steps"], "ladder/steps", whole=True)
        _check_evaluation(rung["evaluation"], "ladder/evaluation")
        if "run" in rung:
            Variant.parse(rung["run"])


def read_object(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file."""
    if (size := path.stat().st_size) > _MAX_BYTES:
        raise ValueError(f"it has {size} bytes; the limit is {_MAX_BYTES}")
    record = json.loads(path.read_text("utf-8"))
    if not isinstance(record, dict):
        raise ValueError("no JSON object")
    return record


@contextmanager
def errors_of(path: Path, what: str = "a training record") -> Iterator[None]:
    """Turn what a wrong record raises into a PolicyError that names the file and says what it is not."""
    try:
        yield
    except KeyError as error:
        raise PolicyError(f"{path}: not {what}: {error} is missing") from None
    except (AttributeError, OSError, OverflowError, RecursionError, TypeError, ValueError) as error:
        reason = str(error) if isinstance(error, ValueError) else repr(error)
        raise PolicyError(f"{path}: not {what}: {reason[:200]}") from None


def _check_evaluation(evaluation: Any, name: str) -> None:
    if not isinstance(evaluation, Mapping):
        raise ValueError(f"{name} must be a table")
    for key in EVALUATION:
        _check_number(evaluation[key], f"{name}/{key}")
    if evaluation["episodes"] < 1:
        raise ValueError(f"{name}/episodes must be 1 or more")


def _check_seconds(record: Mapping[str, Any]) -> None:
    """Check the training time of a record and of the policies that it was improved from."""
    for _ in range(_MAX_HISTORY):
        _check_number(record["wall_seconds"], "wall_seconds")
        before = record.get("before")
        if not before:
            return
        record = before
    raise ValueError(f"it was improved more than {_MAX_HISTORY} times")


def _check_number(value: Any, name: str, *, whole: bool = False) -> None:
    kinds = int if whole else int | float
    if isinstance(value, bool) or not isinstance(value, kinds) or not math.isfinite(value):
        kind = "whole" if whole else "finite"
        raise ValueError(f"{name} must be a {kind} number, not {clipped(repr(value)[:90])}")
