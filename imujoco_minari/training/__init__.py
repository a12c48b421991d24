"""Training: an expert for a variant, from scratch or starting from an agent of the base robot.

This package trains agents, selects and evaluates the best one, and stores it as a policy with its training
record. It requires the extra ``[train]`` (SBX and JAX).
"""
