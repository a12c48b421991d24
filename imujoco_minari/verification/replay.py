"""The replay of episodes, bit for bit, and whether their actions are the modes of known policies."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import h5py
import numpy as np

from imujoco_minari.envs.registration import make
from imujoco_minari.policies import Actor
from imujoco_minari.policies.universal import UniversalPolicy
from imujoco_minari.storage import file_format
from imujoco_minari.variants.original import variant_of
from imujoco_minari.verification.expected import known_parts
from imujoco_minari.verification.findings import Finding
from imujoco_minari.verification.structure import is_replayed

# Processor time (s) that a step may take on average, and that is granted on top. Usual steps take 1e-4 s.
STEP_SECONDS, START_SECONDS = 0.02, 1.0
# Machines round float32 differently by less than this, and samples differ from modes by more.
TOLERANCE = 1e-4


def replay(
    file: h5py.File,
    episodes: Sequence[int],
    models: Mapping[str, str],
    on_episode: Callable[[], None],
) -> Iterator[Finding]:
    """Replay episodes from their seeds and actions and compare, bit for bit.

    Imported episodes, which have no seed, are passed over. ``models`` has the MJCF texts of the variants
    whose models do not follow from their ids.
    """
    environments: dict[str, gym.Env[Any, Any]] = {}
    try:
        for number in episodes:
            name = file_format.episode_name(number)
            attributes = file[name].attrs
            variant = str(attributes["variant"])
            if is_replayed(attributes):
                if variant not in environments:
                    environments[variant] = make(variant_of(attributes), models.get(variant))
                yield from _replay_episode(file[name], name, environments[variant])
            on_episode()
    finally:
        for env in environments.values():
            env.close()


def _replay_episode(group: h5py.Group, name: str, env: gym.Env[Any, Any]) -> Iterator[Finding]:
    recorded = {key: group[key][()] for key in file_format.ARRAYS}
    started, clock = time.thread_time(), time.thread_time
    actions, length = recorded["actions"], len(recorded["rewards"])
    replayed = {key: np.empty_like(recorded[key]) for key in file_format.ARRAYS if key != "actions"}
    observations, rewards = replayed["observations"], replayed["rewards"]
    terminations, truncations = replayed["terminations"], replayed["truncations"]
    observations[0], _ = env.reset(seed=int(group.attrs["seed"]))
    steps, step = length, env.step
    for index, action in enumerate(actions):
        observation, reward, terminated, truncated, _ = step(action)
        observations[index + 1] = observation
        rewards[index] = reward
        terminations[index], truncations[index] = terminated, truncated
        if terminated or truncated:
            steps = index + 1
            break
        # To read the clock takes 1e-6 s, a fortieth of a step.
        if index % 10 == 9 and clock() - started > START_SECONDS + STEP_SECONDS * (index + 1):
            yield Finding(
                name,
                f"was replayed to step {index + 1} only: a step takes more than {STEP_SECONDS} s",
            )
            return
    if steps < length:
        yield Finding(name, f"has {length} steps, but its replay ends after {steps}")
    for key, values in replayed.items():
        rows = steps + 1 if key == "observations" else steps
        # Compared as bytes, so that -0.0 is not 0.0.
        ours = values[:rows].reshape(rows, -1).view(np.uint8)
        theirs = recorded[key][:rows].reshape(rows, -1).view(np.uint8)
        differing = np.flatnonzero((ours != theirs).any(axis=1))
        if len(differing):
            yield Finding(
                f"{name}/{key}[{differing[0]}]",
                f"differs from its replay by {simulator()}, as do {len(differing) - 1} later rows",
            )


def actions(file: h5py.File, metadata: Mapping[str, Any]) -> Iterator[Finding]:
    """Report a known policy that did not choose the actions as the metadata of a checked dataset state.

    It looks at the first episode of each policy only, so that the check takes no time beside the replay.
    """
    first = 0
    stated = file[file_format.episode_name(0)].attrs
    for part in known_parts(variant_of(stated), str(stated["tier"]), metadata) or ():
        name = file_format.episode_name(first)
        first += part.episodes
        policy = part.policy
        if isinstance(policy, UniversalPolicy) and part.episodes:
            policy = policy.fold(variant_of(file[name].attrs))
        if part.episodes == 0 or not isinstance(policy, Actor):
            continue
        observations, chosen = file[name]["observations"][:-1], file[name]["actions"][()]
        modes = replace(policy, deterministic=True).act(observations, np.random.default_rng())
        are_modes = np.allclose(chosen, modes, rtol=0, atol=TOLERANCE)
        if are_modes != policy.deterministic:
            yield Finding(
                f"{name}/actions",
                f"are {'the' if are_modes else 'not the'} modes of the policy, and the metadata state "
                f"policy_deterministic: {str(policy.deterministic).lower()}",
            )


def simulator() -> str:
    """Return the versions that decide what a simulation gives, bit for bit."""
    return f"mujoco {version('mujoco')} and gymnasium {version('gymnasium')}"
