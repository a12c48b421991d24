"""Whether a dataset's actions are the modes of the policies that its metadata state."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import h5py
import numpy as np

from imujoco_minari.policies import Actor
from imujoco_minari.policies.universal import UniversalPolicy
from imujoco_minari.storage import file_format
from imujoco_minari.variants.original import variant_of
from imujoco_minari.verification.expected import known_parts
from imujoco_minari.verification.findings import Finding

# Machines round float32 differently by less than this, and samples differ from modes by more.
TOLERANCE = 1e-4


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
