"""Normalised scores: 0 is the return of a variant's random policy, 1 that of its expert."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from imujoco_minari.errors import ArgumentError, PolicyNotFoundError, clipped
from imujoco_minari.policies import Array
from imujoco_minari.policies.references import measured_record
from imujoco_minari.variants import Variant


def normalized_score(variant: Variant | str | Sequence[Variant | str] | Array, returns: ArrayLike) -> Array:
    """Return normalised scores: 0 for the return of a variant's random policy, 1 for that of its expert.

    The references come from the records of the policies, so no dataset is needed. A folded expert is
    evaluated at the first need, which takes seconds.

    Args:
        variant: the variant or its id, or a sequence or array with one for each return, as a collection
            needs.
        returns: undiscounted returns, of any shape; of shape (n,) for a sequence of n variants.

    Returns:
        The scores, float64, of the shape of ``returns``.

    Raises:
        VariantError: when an id is not of a variant.
        PolicyNotFoundError: when a variant has no expert.
        ArgumentError: when ``returns`` are not numbers, or not as many as the variants.

    Example:
        >>> normalized_score("hopper-base", [18.0, 3500.0])  # doctest: +SKIP
        array([0.001, 0.977])
    """
    values = np.asarray(returns)
    if values.dtype.kind not in "fiu":
        raise ArgumentError(f"returns must be numbers, not {clipped(repr(returns))}")
    if isinstance(variant, np.ndarray):
        variant = variant.tolist()
    if isinstance(variant, Variant | str):
        low, high = _references(Variant.parse(variant))
        return np.asarray((values - low) / (high - low))
    if not isinstance(variant, Sequence) or values.shape != (len(variant),):
        raise ArgumentError(
            "give a variant, or a sequence with one variant for each return; "
            f"the returns have the shape {values.shape}"
        )
    variants = [Variant.parse(each) for each in variant]
    known = {each: _references(each) for each in dict.fromkeys(variants)}
    lows, highs = np.array([known[each] for each in variants]).reshape(-1, 2).T
    return np.asarray((values - lows) / (highs - lows))


def _references(variant: Variant) -> tuple[float, float]:
    """Return the returns that score 0 and 1."""
    record = measured_record(variant)
    if "evaluation" not in record:
        raise PolicyNotFoundError(
            f"{variant} has no expert, so no return scores 1: train one with `imujoco train {variant}`"
        )
    return float(record["random"]["return_mean"]), float(record["evaluation"]["return_mean"])
