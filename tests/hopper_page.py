"""A robot's page that is Hopper's, for tests that add tables to it."""

from __future__ import annotations


def hopper_page(model: str, tables: str) -> str:
    """Return the page of a robot with Hopper's keys, the MJCF file ``model`` and the given tables."""
    return f"""
environment = "Hopper-v5"
model = "{model}"
observation_size = 11
observed_positions = 5
action_size = 3
steps_per_second = 125
root_joints = ["rootx", "rootz", "rooty"]
feet = ["foot_geom"]
healthy_z_range = [0.7, inf]
{tables}"""
