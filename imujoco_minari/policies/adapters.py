"""Policies of users and of other libraries, as functions that act on several observations at once."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

from imujoco_minari.errors import PolicyError
from imujoco_minari.policies.doors import Array
from imujoco_minari.policies.universal import UniversalPolicy

# Observations of shape (b, obs) and a source of random numbers for each -> actions of shape (b, act).
BatchAct: TypeAlias = Callable[[Array, Sequence[np.random.Generator]], Any]


def batch_act(policy: Any) -> BatchAct:
    """Return the function that computes the actions of a policy for several observations.

    Args:
        policy: the first of these that fits:

            - an object with ``act(observation, rng)``, as this package's policies; its method
              ``act_together(observations, rngs)`` is used if it has one;
            - an object with ``predict(observations)`` for a batch, as those of Stable-Baselines3 and SBX,
              which act deterministically, and of d3rlpy;
            - a torch module, called in evaluation mode with a float32 tensor of shape (b, obs);
            - a function of one observation.

    Raises:
        PolicyError: when it is none of them.
    """
    if isinstance(policy, type):
        raise PolicyError(f"a policy is an object, but {policy.__name__} is a class: make an object of it")
    if callable(getattr(policy, "act_together", None)):
        together: BatchAct = policy.act_together
        return together
    # A module of torch exists only where torch is imported, which takes seconds.
    torch = sys.modules.get("torch")
    is_module = torch is not None and isinstance(policy, torch.nn.Module)
    if not is_module and callable(getattr(policy, "act", None)):
        return lambda observations, rngs: [policy.act(*each) for each in zip(observations, rngs, strict=True)]
    if callable(getattr(policy, "predict", None)):
        return lambda observations, rngs: _predict(policy.predict, observations)
    if is_module:
        return lambda observations, rngs: _forward(policy, observations)
    if callable(policy):
        return lambda observations, rngs: [policy(each) for each in observations]
    hint = "; load a file with load_policy(variant, path=...)" if isinstance(policy, str) else ""
    if isinstance(policy, UniversalPolicy):
        hint = "; for one variant, take policy.fold(variant)"
    raise PolicyError(
        "a policy is a function of the observation, a torch module, or an object with act() or predict(), "
        f"not {type(policy).__name__}{hint}"
    )


def checked(act: BatchAct, shape: tuple[int, ...]) -> BatchAct:
    """Return ``act`` with a check of every result: finite numbers, of ``shape`` for each observation.

    The first call turns any exception into a PolicyError, so that a wrong policy fails before the first step.
    """
    called = False

    def call(observations: Array, rngs: Sequence[np.random.Generator]) -> Array:
        nonlocal called
        try:
            actions = np.asarray(act(observations, rngs))
        except Exception as error:
            if called or isinstance(error, PolicyError):
                raise
            raise PolicyError(
                f"the policy fails on observations of shape {observations.shape[1:]}: "
                f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
            ) from error
        called = True
        if actions.shape != (len(observations), *shape):
            raise PolicyError(
                f"the policy returns actions of shape {actions.shape} for {len(observations)} observations; "
                f"valid: {(len(observations), *shape)}"
            )
        if actions.dtype.kind not in "fiu" or not np.isfinite(actions).all():
            raise PolicyError("the policy returns actions that are not finite numbers")
        return actions

    return call


def _predict(predict: Callable[..., Any], observations: Array) -> Any:
    if "deterministic" not in inspect.signature(predict).parameters:
        return predict(observations)
    actions, state = predict(observations, deterministic=True)
    if state is not None:
        raise PolicyError("the policy is recurrent: predict() returns a state, which is not supported")
    return actions


def _forward(module: Any, observations: Array) -> Any:
    import torch

    parameter = next(module.parameters(), torch.empty(0))
    modes = [(part, part.training) for part in module.modules()] if module.training else []
    module.eval()
    try:
        with torch.no_grad():
            actions = module(torch.as_tensor(observations, dtype=parameter.dtype, device=parameter.device))
    finally:
        for part, training in modes:
            part.training = training
    if not isinstance(actions, torch.Tensor):
        raise PolicyError(
            f"the torch module returns a {type(actions).__name__}, not a tensor of actions: "
            "pass a function of the observation that returns the action"
        )
    return actions.cpu().numpy()
