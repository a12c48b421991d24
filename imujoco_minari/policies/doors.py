"""The ways to ask a policy for an action: ``act``, a call, and ``predict`` as in Stable-Baselines3."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import ArgumentError

Array = NDArray[Any]


class Doors:
    """A policy with an ``act`` method, which can also be called and asked to predict."""

    deterministic: bool

    def act(self, observation: Array, rng: np.random.Generator | None = None) -> Array:
        """Return the action for an observation; see the policy's own method."""
        raise NotImplementedError

    def __call__(self, observation: Array, rng: np.random.Generator | None = None) -> Array:
        """Return what ``act`` returns.

        Raises:
            ArgumentError: when the observation has another length than the policy takes.
        """
        return self.act(self._fitting(observation), rng)

    def predict(
        self,
        observation: Array,
        state: None = None,
        episode_start: Array | None = None,
        deterministic: bool | None = None,
        *,
        rng: np.random.Generator | None = None,
    ) -> tuple[Array, None]:
        """Return the action and no state, as a model of Stable-Baselines3 does.

        Args:
            observation: of shape ``(n,)``, or a batch of shape ``(b, n)``.
            state: not used; the policies of this package have no state.
            episode_start: not used.
            deterministic: take the mode of the distribution, or a sample. None for what the policy does.
            rng: source of the sample; None for NumPy's global one, as in Stable-Baselines3, where
                ``np.random.seed`` sets it. A deterministic action does not use it.

        Raises:
            ArgumentError: when the observation has another length than the policy takes, or a random policy
                is asked for a mode.

        Example:
            >>> action, _ = load_policy("hopper-base").predict(observation)  # doctest: +SKIP
        """
        observation = self._fitting(observation)
        policy = self
        if deterministic is not None and deterministic != self.deterministic:
            policy = self.changed(deterministic)
        if rng is None and not policy.deterministic:
            rng = np.random.default_rng(np.random.randint(2**31))
        return policy.act(observation, rng), None

    def _fitting(self, observation: Array) -> Array:
        """Return the observation as an array of a length that the policy takes."""
        array, size = np.asarray(observation), getattr(self, "observation_size", None)
        if size is not None and array.shape[-1:] != (size,):
            raise ArgumentError(
                f"the observation has the shape {array.shape}; valid: ({size},), or (batch, {size})"
            )
        return array

    def changed(self, deterministic: bool) -> Doors:
        """Return the same policy, acting deterministically or not."""
        return replace(self, deterministic=deterministic)  # type: ignore[type-var]


def given(rng: np.random.Generator | None) -> np.random.Generator:
    """Return the source of random numbers.

    Raises:
        ArgumentError: when there is none.
    """
    if rng is None:
        raise ArgumentError(
            "this policy samples its actions and needs a source of random numbers: "
            "act(observation, rng=np.random.default_rng(0))"
        )
    return rng
