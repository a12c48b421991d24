"""Policies and what they score: a random policy, the experts, and actors from files.

This package reads and writes policies, chooses the policies of each tier, runs them in environments and
evaluates them. It knows nothing of datasets.
"""

from imujoco_minari.policies.actors import LANES, Actor, Policy
from imujoco_minari.policies.doors import Array
from imujoco_minari.policies.experts import (
    agent_file,
    expert_actor,
    expert_record,
    expert_variants,
    find_policy_file,
    own_record,
    policies_folder,
    universal_policy,
)
from imujoco_minari.policies.files import read_actor
from imujoco_minari.policies.tiers import load_policy
from imujoco_minari.policies.uniform import RandomPolicy, random_policy

__all__ = [
    "LANES",
    "Actor",
    "Array",
    "Policy",
    "RandomPolicy",
    "agent_file",
    "expert_actor",
    "expert_record",
    "expert_variants",
    "find_policy_file",
    "load_policy",
    "own_record",
    "policies_folder",
    "random_policy",
    "read_actor",
    "universal_policy",
]
