"""The transfer of policies to other variants: evaluates every policy on every variant.

Each result is written to a state file at once, so an interrupted run continues where it stopped. If a policy,
a model or a setting has changed, its results are computed again.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from imujoco_minari.envs.mjcf import canonical_mjcf, mjcf_sha256
from imujoco_minari.errors import JobError, PolicyNotFoundError, TransferError
from imujoco_minari.parallel import run_jobs
from imujoco_minari.policies import Actor, Policy, expert_actor, expert_record
from imujoco_minari.policies.evaluation import Evaluation, evaluate
from imujoco_minari.policies.records import EVALUATION
from imujoco_minari.short_repr import short_repr
from imujoco_minari.storage.files import write_text
from imujoco_minari.variants import Variant, catalogue

FORMAT = 2
COLUMNS = ("policy", "variant", "category", *EVALUATION)


@dataclass(frozen=True)
class Transfer:
    """The evaluations of policies on variants, as a matrix.

    Attributes:
        policies: names of the policies, the rows.
        variants: the variants, the columns.
        cells: maps every pair (policy, variant) to its evaluation.
    """

    policies: tuple[str, ...]
    variants: tuple[Variant, ...]
    cells: Mapping[tuple[str, Variant], Evaluation]

    __repr__ = short_repr

    def returns(self) -> list[list[float]]:
        """Return the mean undiscounted returns, one list per policy."""
        return [
            [self.cells[policy, variant].return_mean for variant in self.variants] for policy in self.policies
        ]


class _Cell(NamedTuple):
    policy_name: str
    policy: Policy
    variant: Variant
    episodes: int
    seed: int

    def key(self) -> str:
        """Return everything that decides the result as text. The state file stores it with the result."""
        model = mjcf_sha256(canonical_mjcf(self.variant))
        return f"{self.policy.sha256} {self.policy.deterministic} {model} {self.episodes} {self.seed}"

    def evaluation(self, row: Mapping[str, Any]) -> Evaluation:
        """Return the result from its row of the state file."""
        returns, lengths = np.array(row["returns"]), np.array(row["lengths"])
        variants = (str(self.variant),) * self.episodes
        return Evaluation(returns, lengths, variants, self.seed, self.policy.deterministic)


def expert_policies(robot: str, category: str | None = None) -> dict[str, Policy]:
    """Return the expert policies of a robot's :func:`columns`, own and folded, by the ids of their variants.

    Raises:
        PolicyNotFoundError: if none of them has an expert.
    """
    chosen = [variant for variant in columns(robot, category) if expert_record(variant)]
    if not chosen:
        raise PolicyNotFoundError(
            f"no expert policy of {robot}{f' for {category}' if category else ''}: train some with "
            "`imujoco train`, or give some with --policy FILE"
        )
    return {str(variant): expert_actor(variant) for variant in chosen}


def columns(robot: str, category: str | None = None) -> tuple[Variant, ...]:
    """Return the variants to evaluate a robot's policies on: its base, then those of the catalogue."""
    return (Variant(robot), *catalogue(robot, category))


def evaluate_transfer(
    policies: Mapping[str, Policy],
    variants: Sequence[Variant],
    state: Path,
    *,
    episodes: int = 5,
    seed: int = 0,
    jobs: int = 1,
    on_cell: Callable[[], None] = lambda: None,
) -> Transfer:
    """Evaluate every policy on every variant.

    Args:
        policies: maps names to policies.
        variants: variants of one robot.
        state: JSON file of the results. The results of an earlier run are reused.
        episodes: number of episodes per pair of policy and variant.
        seed: base seed of the episodes, the same for every pair.
        jobs: number of processes.
        on_cell: called when the evaluation of a pair is ready.

    Raises:
        PolicyError: if a policy does not fit the robot.
        TransferError: if the state file has another format, or a process was lost.
        StorageError: if the state file cannot be written.
    """
    robot = variants[0].robot
    fitting = {
        name: policy.for_robot(robot) if isinstance(policy, Actor) else policy
        for name, policy in policies.items()
    }
    wanted = [
        _Cell(name, policy, variant, episodes, seed)
        for name, policy in fitting.items()
        for variant in variants
    ]
    known = _read_state(state)
    cells, missing = {}, []
    for cell in wanted:
        row = known.get(cell.policy_name, {}).get(str(cell.variant), {})
        if row.get("key") == cell.key():
            cells[cell.policy_name, cell.variant] = cell.evaluation(row)
            on_cell()
        else:
            missing.append(cell)
    for number, result in run_jobs(_evaluate_cell, missing, jobs=jobs):
        cell = missing[number]
        if isinstance(result, JobError):
            raise TransferError(f"{cell.policy_name} on {cell.variant}: {result}")
        row = {
            "key": cell.key(),
            "returns": result.returns.tolist(),
            "lengths": result.lengths.tolist(),
        }
        known.setdefault(cell.policy_name, {})[str(cell.variant)] = row
        write_text(state, json.dumps({"format": FORMAT, "cells": known}) + "\n")
        cells[cell.policy_name, cell.variant] = result
        on_cell()
    return Transfer(tuple(policies), tuple(variants), cells)


def write_csv(transfer: Transfer, path: Path) -> None:
    """Write a transfer as CSV, one line for each pair of policy and variant.

    Raises:
        StorageError: if the file cannot be written.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for policy in transfer.policies:
        for variant in transfer.variants:
            row = {"policy": policy, "variant": str(variant), "category": variant.category}
            writer.writerow(row | transfer.cells[policy, variant].asdict())
    write_text(path, text.getvalue())


def _evaluate_cell(cell: _Cell) -> Evaluation:
    return evaluate(cell.variant, cell.policy, episodes=cell.episodes, seed=cell.seed)


def _read_state(state: Path) -> dict[str, dict[str, Any]]:
    if not state.exists():
        return {}
    try:
        data = json.loads(state.read_text("utf-8"))
        if data["format"] == FORMAT and isinstance(data["cells"], dict):
            return dict(data["cells"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    raise TransferError(f"{state} is not a state file of a transfer: remove it, or name another --output")
