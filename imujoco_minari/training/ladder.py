"""The ladder of a variant: its base's rungs, evaluated on the variant, and rungs of its own.

A tier needs rungs of certain returns. What the base's rungs do not have comes from the checkpoints of the
variant's own run, from the rungs of other variants, or from a short run from scratch: the climb.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from imujoco_minari.policies import Actor, own_record
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.rungs import (
    LADDER_EPISODES,
    LADDER_SEED,
    MEDIUM_SHARE,
    mean_return,
    medium_rung,
    read_rung,
    rung_file,
    rungs_of_variants,
)
from imujoco_minari.training.agents import actor_of, load_arrays, save_arrays
from imujoco_minari.training.hyperparameters import SCRATCH, hyperparameters
from imujoco_minari.training.plan import Plan
from imujoco_minari.training.run import OnInterval, Run
from imujoco_minari.training.task import Task
from imujoco_minari.variants import BASE, Variant

# Shares of the base expert's return. The checkpoint nearest to each is kept as a rung.
SHARES = (0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.7, 0.85)
# Shares of the expert's return that the tiers need, and how far a rung may be off.
NEEDED, TOLERANCE = (MEDIUM_SHARE, 0.8, 0.6, 0.2), 0.08
MEDIUM_EPISODES = 100
# The climb: minutes of a core. The first third of the expert's return takes 30,000 to 130,000 steps.
CLIMB_STEPS, CLIMB_INTERVAL = 150_000, 2_000


class Ladder:
    """The ladder of a variant while it is built.

    Args:
        variant: the variant, or a base.
        expert_return: the mean return of its expert.
        policies: the folder of policies. It receives the rungs that are the variant's own.

    Attributes:
        rungs: the entries of the ladder, for the record.
    """

    def __init__(self, variant: Variant, expert_return: float, policies: Path) -> None:
        self.variant, self.expert_return, self.policies = variant, expert_return, policies
        self.rungs: list[dict[str, Any]] = []
        # A base's own rungs are those of all its variants, so their entries name no run.
        self._run = {} if variant.category == BASE else {"run": str(variant)}

    def add_known(self) -> None:
        """Evaluate the rungs that the records of the variant and of its base list, and add them."""
        base, own = (
            own_record(each, self.policies).get("ladder", []) for each in (self.variant.base, self.variant)
        )
        known = [{"steps": rung["steps"]} for rung in base]
        known += [{"run": rung["run"], "steps": rung["steps"]} for rung in own if "run" in rung]
        for rung in known:
            actor = read_rung(self.variant, rung, self.policies)
            self.rungs.append(rung | {"evaluation": self._evaluate(actor, LADDER_EPISODES)})
        self._settle_medium()

    def add_spread(self, folder: Path, evaluations: Sequence[Mapping[str, Any]]) -> None:
        """Add the checkpoint nearest to each of :data:`SHARES`. This makes the first ladder of a base.

        Args:
            folder: the run's checkpoints, one actor per file, named by its steps.
            evaluations: the run's evaluations, each with ``steps`` and ``return_mean``.
        """
        for steps in sorted({self._nearest(evaluations, share) for share in SHARES}):
            self._add_checkpoint(folder, steps, LADDER_EPISODES)
        self._settle_medium()

    def add_missing(self, folder: Path, evaluations: Sequence[Mapping[str, Any]]) -> None:
        """Add the checkpoints that have the return of a missing share.

        Args:
            folder: the run's checkpoints, one actor per file, named by its steps.
            evaluations: the run's evaluations, each with ``steps`` and ``return_mean``.
        """
        # An earlier run of a base may have saved a rung after as many steps.
        taken = [rung["steps"] for rung in self.rungs if self._run.items() <= rung.items()]
        free = [entry for entry in evaluations if entry["steps"] not in taken]
        for share in self.missing():
            # Five episodes state a return roughly, so this looks a little further.
            near = [entry for entry in free if self._is_near(entry["return_mean"], share, 2 * TOLERANCE)]
            if near:
                episodes = MEDIUM_EPISODES if share == MEDIUM_SHARE else LADDER_EPISODES
                self._add_checkpoint(folder, self._nearest(near, share), episodes, share)
        self._settle_medium()

    def add_borrowed(self) -> None:
        """If the medium rung is missing, add needed rungs that other variants of the robot made.

        To try one takes seconds, and a climb takes minutes.
        """
        for rung in rungs_of_variants(self.variant.robot, self.policies):
            if MEDIUM_SHARE not in self.missing():
                return
            if rung["run"] == str(self.variant):
                continue
            measured = self._evaluate(read_rung(self.variant, rung, self.policies), LADDER_EPISODES)
            if any(self._is_near(measured["return_mean"], share) for share in self.missing()):
                self.rungs.append(rung | {"evaluation": measured})
                self._settle_medium()

    def climb(self, plan: Plan, folder: Path, on_interval: OnInterval) -> None:
        """If needed rungs are missing, train from scratch for a while and add the checkpoints that fit.

        A variant needs a medium rung, and first tries the rungs of other variants. A base gives its rungs to
        its variants, so it needs all.

        Args:
            plan: the settings.
            folder: the state folder of the climb.
            on_interval: called after each interval.
        """
        if self.variant.category == BASE:
            needed = set(NEEDED)
        else:
            needed = {MEDIUM_SHARE}
            self.add_borrowed()
        if not needed & self.missing():
            return
        with closing(Run(climb_task(self.variant, plan), folder, device=plan.device)) as run:
            self.add_missing(folder / "ladder", run.progress.evaluations)
            while needed & self.missing() and not run.finished:
                run.train_interval()
                on_interval(run.progress, run.task)
                self.add_missing(folder / "ladder", run.progress.evaluations[-1:])

    def missing(self) -> set[float]:
        """Return the needed shares of the expert's return that no rung has."""
        returns = [mean_return(rung) for rung in self.rungs]
        return {share for share in NEEDED if not any(self._is_near(value, share) for value in returns)}

    def _add_checkpoint(self, folder: Path, steps: int, episodes: int, share: float | None = None) -> None:
        """Evaluate a checkpoint and add it, unless a share is given and it does not have that return."""
        arrays = load_arrays(folder / f"{steps}.safetensors")
        measured = self._evaluate(actor_of(arrays, self.variant.robot), episodes)
        if share is None or self._is_near(measured["return_mean"], share):
            save_arrays(self.policies / rung_file(self.variant, steps), arrays)
            self.rungs.append(self._run | {"steps": steps, "evaluation": measured})

    def _settle_medium(self) -> None:
        """Evaluate the medium rung with 100 episodes. Then another rung may be nearer to its share."""
        while self.rungs:
            medium = medium_rung(self.rungs, self.expert_return)
            if medium["evaluation"]["episodes"] >= MEDIUM_EPISODES:
                return
            actor = read_rung(self.variant, medium, self.policies)
            medium["evaluation"] = self._evaluate(actor, MEDIUM_EPISODES)

    def _nearest(self, evaluations: Sequence[Mapping[str, Any]], share: float) -> int:
        """Return the steps of the checkpoint whose return is nearest to a share of the expert's."""
        wanted = share * self.expert_return
        return int(min(evaluations, key=lambda entry: abs(entry["return_mean"] - wanted))["steps"])

    def _is_near(self, value: float, share: float, tolerance: float = TOLERANCE) -> bool:
        return abs(value - share * self.expert_return) <= tolerance * abs(self.expert_return)

    def _evaluate(self, actor: Actor, episodes: int) -> dict[str, Any]:
        return evaluate(self.variant, actor, episodes=episodes, seed=LADDER_SEED).asdict()


def climb_task(variant: Variant, plan: Plan) -> Task:
    """Return the short run from scratch that gives a variant the rungs that it lacks."""
    settings = hyperparameters(variant.robot, SCRATCH, **plan.changes)
    settings = replace(
        settings,
        max_steps=min(settings.max_steps, CLIMB_STEPS),
        evaluate_every=min(settings.evaluate_every, CLIMB_INTERVAL),
        settling_steps=0,
        choosing_episodes=settings.ranking_episodes,
        deciding_episodes=settings.ranking_episodes,
    )
    return Task(variant, settings, plan.seed, purpose="the lower tiers")
