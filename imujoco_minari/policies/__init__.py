"""Policies and their scores: a random policy, the experts, and actors from files.

The package finds or reads the policy that makes a variant's data (:func:`load_policy`), rolls policies
out, and states the reference scores of a variant. Policies act in NumPy; no function here imports torch,
except for the export to a Stable-Baselines3 zip.
"""

from imujoco_minari.policies.actors import LANES, SIZES, Actor, Array, Policy, RandomPolicy
from imujoco_minari.policies.experts import (
    agent_file,
    expert_actor,
    expert_record,
    expert_variants,
    find_policy_file,
    policies_folder,
)
from imujoco_minari.policies.files import read_actor
from imujoco_minari.policies.tiers import load_policy

__all__ = [
    "LANES",
    "SIZES",
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
