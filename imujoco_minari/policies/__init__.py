"""Policies: a random one, the experts, and actors out of files."""

from imujoco_minari.policies.actors import LANES, Actor, Array, Policy, RandomPolicy
from imujoco_minari.policies.experts import (
    agent_file,
    expert_actor,
    expert_record,
    expert_variants,
    find_policy_file,
    load_policy,
    policies_folder,
)
from imujoco_minari.policies.files import read_actor

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
    "policies_folder",
    "read_actor",
]
