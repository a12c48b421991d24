"""One training run, with checkpoints: a killed run loses at most one interval.

A run trains a policy for one variant, or a universal policy over many. It is a sequence of intervals of
``evaluate_every`` steps. Each interval begins new episodes in all lanes. Its random numbers depend only on
the seed and its number, so a run that is killed and resumed has the same weights at the end, bit for bit, as
an uninterrupted one (on the same processor and versions).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.errors import TrainingError
from imujoco_minari.policies import Actor, Array
from imujoco_minari.policies.references import CONFIRMING_SEED, random_evaluation
from imujoco_minari.policies.rollouts import episode_seed
from imujoco_minari.policies.rungs import share_of
from imujoco_minari.training.agents import (
    ALGORITHM,
    STARTING,
    actor_of,
    actor_weights,
    agent_actor,
    agent_arrays,
    as_stored,
    load_arrays,
    make_agent,
    replace_actor,
    restore_agent,
    save_arrays,
)
from imujoco_minari.training.buffer import ReplayBuffer
from imujoco_minari.training.hyperparameters import SCRATCH
from imujoco_minari.training.lanes import Lanes, Wrap
from imujoco_minari.training.selection import RANKING_SEED, better, look
from imujoco_minari.training.task import Task
from imujoco_minari.training.updates import hold, set_rates, update
from imujoco_minari.variants import BASE, Variant, specification

# Calls of the update loop between two updates of the averaged weights.
_AVERAGED_CALLS = 50
# A policy delay that no number of updates reaches: only the critics learn.
_NEVER = 10**9
_CHECKPOINT_NAME, _BEST_NAME = "checkpoint.safetensors", "best-agent.safetensors"


@dataclass
class Progress:
    """The progress of a run, stored with every checkpoint.

    Attributes:
        intervals: intervals done.
        steps: environment steps done.
        updates: gradient steps done.
        wall_seconds: wall time in seconds, evaluations included.
        best: evaluation of the best actor over the deciding episodes; empty before the first actor.
        best_score: its score; -inf before the first actor.
        best_steps: environment steps at which the best actor was found.
        evaluations: one entry for each evaluated interval: ``steps``, the evaluations of the ``present`` and
            of the ``average`` weights, and ``best`` if one of them is the best actor so far.
        episodes: number of training episodes begun. It seeds the next episode.
        running: variant -> running share of its training episodes, over several variants.
    """

    intervals: int = 0
    steps: int = 0
    updates: int = 0
    wall_seconds: float = 0.0
    best: dict[str, Any] = field(default_factory=dict)
    best_score: float = float("-inf")
    best_steps: int = 0
    evaluations: list[dict[str, Any]] = field(default_factory=list)
    episodes: int = 0
    running: dict[str, float] = field(default_factory=dict)


# Called after every interval.
OnInterval = Callable[[Progress, Task], None]


def do_nothing(progress: Progress, task: Task) -> None:
    """Do nothing after an interval."""


class Run:
    """A training run in a state folder. A run whose folder has a checkpoint is resumed.

    Args:
        task: the description of the run.
        folder: state of this run alone; created if it does not exist.
        wrap: wraps each training environment, for example to record it.
        device: see :func:`~imujoco_minari.training.agents.make_agent`.

    Raises:
        TrainingError: if the checkpoint is of another version of this package.
    """

    def __init__(self, task: Task, folder: Path, wrap: Wrap | None = None, device: str | None = None) -> None:
        self.task, self.folder, self.progress = task, folder, Progress()
        settings, page = task.settings, specification(task.variant.robot)
        self._lanes = Lanes(
            task.variant.robot, settings.lanes, self._choose, task.seed, told=task.over is not None, wrap=wrap
        )
        inputs = self._lanes.inputs.shape[1]
        self._buffer = ReplayBuffer(settings.buffer_size, inputs, page.observation_size, page.action_size)
        self._agent = make_agent(inputs, page.action_size, settings, task.seed, device)
        agent = task.start.agent
        if agent and settings.anchor:
            # What the run began as holds it, also after it was resumed.
            hold(self._agent, agent_actor(agent), settings.anchor)
        if (folder / _CHECKPOINT_NAME).is_file():
            self._load_checkpoint()
        else:
            if agent:
                restore_agent(self._agent, agent, STARTING)
            self._average = actor_weights(self._agent)
        self._rng = np.random.default_rng()
        self._actor: Actor | None = None

    def train(self, on_interval: OnInterval = do_nothing) -> None:
        """Train until the target or the last step. The best actor is in the folder then.

        Args:
            on_interval: called with the progress and the task after every interval.
        """
        if self.task.start.agent and not self.progress.evaluations:
            self._evaluate(time.monotonic())
            on_interval(self.progress, self.task)
        while not self.finished:
            self.train_interval()
            on_interval(self.progress, self.task)

    @property
    def finished(self) -> bool:
        """Whether the run has reached its target or its last step."""
        reached = self.progress.best_score >= self.task.target
        return reached or self.progress.steps >= self.task.settings.max_steps

    def best_agent(self) -> dict[str, Array]:
        """Return the best actor and the critics of its time, as arrays of an agent."""
        return load_arrays(self.folder / _BEST_NAME)

    def close(self) -> None:
        """Close the environments."""
        self._lanes.close()

    def train_interval(self) -> None:
        """Train for one interval, evaluate the actor and write a checkpoint."""
        begin = time.monotonic()
        settings, progress = self.task.settings, self.progress
        self._rng = np.random.default_rng([self.task.seed, progress.intervals])
        set_rates(self._agent, settings.rate(progress.steps))
        exploring = progress.steps < settings.exploration_steps
        end = progress.steps + settings.evaluate_every
        if exploring:
            end = min(end, settings.exploration_steps)
        elif not progress.updates:
            for _ in range(settings.critic_updates // settings.updates_per_call):
                self._update(_NEVER)
        self._lanes.restart()
        while progress.steps < end:
            for _ in range(max(1, settings.steps_per_call // settings.lanes)):
                self._step(randomly=exploring and self.task.start.name == SCRATCH)
            if not exploring:
                self._update(settings.policy_delay)
                progress.updates += settings.updates_per_call
                if progress.updates // settings.updates_per_call % _AVERAGED_CALLS == 0:
                    kept = settings.average
                    self._average = {
                        name: kept * self._average[name] + (1 - kept) * array
                        for name, array in actor_weights(self._agent).items()
                    }
        progress.intervals += 1
        # A run that ends before its first update has the actor that it began with.
        if not exploring or self.finished:
            self._evaluate(begin)
        else:
            progress.wall_seconds += time.monotonic() - begin
        self._save_checkpoint()

    def _choose(self, lane: int, episode: int) -> Variant:
        """Return the variant of a training episode."""
        if self.task.over is None:
            return self.task.variant
        return self.task.over.choose(self._rng, episode_seed(self.task.seed, episode), self.progress.running)

    def _step(self, *, randomly: bool) -> None:
        """Act once in every lane and store the transitions."""
        inputs, over = self._lanes.inputs, self.task.over
        if randomly:
            shape = (len(inputs), specification(self.task.variant.robot).action_size)
            actions = self._rng.uniform(-1, 1, shape).astype(np.float32)
        else:
            actions = self._sampled(inputs)
        stepped = self._lanes.step(actions)
        self._buffer.add(
            inputs=inputs,
            following=stepped.following,
            actions=actions,
            rewards=stepped.rewards,
            dones=stepped.terminated,
        )
        self.progress.steps += len(inputs)
        self.progress.episodes = self._lanes.episodes
        for variant, total in stepped.ended:
            if over is not None and variant in over.listed:
                name, share = str(variant), share_of(total, over.expert)
                before = self.progress.running.get(name, share)
                self.progress.running[name] = 0.7 * before + 0.3 * share

    def _sampled(self, inputs: Array) -> Array:
        """Return actions that the present policy samples, in [-1, 1]."""
        if self._actor is None:
            self._actor = Actor(actor_weights(self._agent), ALGORITHM)
        mean, log_std = self._actor.distribution(inputs)
        noise = self._rng.standard_normal(mean.shape, dtype=np.float32)
        return np.asarray(np.tanh(mean + np.exp(log_std) * noise))

    def _update(self, delay: int) -> None:
        """Call the update loop once."""
        settings = self.task.settings
        count, offset = settings.updates_per_call, (self.progress.updates + 1) % delay
        data = self._buffer.sample(self._rng, count * settings.batch_size, settings.gamma)
        update(self._agent, data, count, delay, offset)
        self._actor = None

    def _evaluate(self, begin: float) -> None:
        """Evaluate the present and the averaged weights as they are stored, and save the best."""
        progress, task = self.progress, self.task
        candidates = {"present": as_stored(actor_weights(self._agent))}
        if progress.updates:
            candidates["average"] = as_stored(self._average)
        entry: dict[str, Any] = {"steps": progress.steps}
        for kind, arrays in candidates.items():
            ranked = look(task, arrays, task.settings.ranking_episodes, RANKING_SEED)
            entry[kind] = ranked.summary
            if found := better(task, arrays, ranked, progress.best_score):
                entry["best"] = kind
                progress.best, progress.best_score = found.summary, found.score
                progress.best_steps = progress.steps
                agent = replace_actor(agent_arrays(self._agent), arrays)
                starting = {name: array for name, array in agent.items() if name.startswith(STARTING)}
                save_arrays(self.folder / _BEST_NAME, starting)
        if task.over is None and task.variant.category == BASE:
            save_arrays(self.folder / "ladder" / f"{progress.steps}.safetensors", candidates["present"])
        progress.wall_seconds += time.monotonic() - begin
        progress.evaluations.append(entry)

    def _save_checkpoint(self) -> None:
        # One file, replaced in one step, so agent, buffer and progress are always of the same interval.
        parts = {"agent": agent_arrays(self._agent), "average": self._average, "buffer": self._buffer.state()}
        arrays = {f"{part}/{name}": array for part, held in parts.items() for name, array in held.items()}
        text = json.dumps(vars(self.progress)).encode()
        save_arrays(self.folder / _CHECKPOINT_NAME, arrays | {"progress": np.frombuffer(text, np.uint8)})

    def _load_checkpoint(self) -> None:
        parts: dict[str, dict[str, Array]] = {"agent": {}, "average": {}, "buffer": {}, "progress": {}}
        for path, array in load_arrays(self.folder / _CHECKPOINT_NAME).items():
            part, _, name = path.partition("/")
            parts.setdefault(part, {})[name] = array
        try:
            self.progress = Progress(**json.loads(parts["progress"][""].tobytes()))
            self._buffer.restore(parts["buffer"])
        except (TypeError, KeyError):
            raise TrainingError(
                "the unfinished run is of another version of this package: remove its state folder"
            ) from None
        restore_agent(self._agent, parts["agent"])
        self._average, self._lanes.episodes = parts["average"], self.progress.episodes

    def make_record(self) -> dict[str, Any]:
        """Evaluate the best actor of one variant on seeds that did not select it; return its record."""
        task, progress = self.task, self.progress
        arrays = agent_actor(self.best_agent())
        confirmed = look(task, arrays, task.settings.confirming_episodes, CONFIRMING_SEED).summary
        return {
            "variant": str(task.variant),
            "algorithm": ALGORITHM,
            "library": f"sbx-rl {version('sbx-rl')}",
            "start": task.start.name,
            "start_sha256": task.start.sha256,
            "start_told": task.start.told,
            "steps": progress.best_steps,
            "steps_trained": progress.steps,
            "updates": progress.updates,
            "seed": task.seed,
            "hyperparameters": task.settings.asdict(),
            "wall_seconds": round(progress.wall_seconds, 1),
            "versions": versions(),
            "weights_sha256": actor_of(arrays, task.variant.robot).sha256,
            "selection": progress.best,
            "evaluation": confirmed,
            "random": random_evaluation(task.variant),
        }


def versions() -> dict[str, str]:
    """Return the versions of the libraries that decide a run's weights."""
    return {name: version(name) for name in ("mujoco", "gymnasium", "jax", "sbx-rl", "numpy")}
