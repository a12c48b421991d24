"""One training run of a variant's expert, with checkpoints: a killed run loses at most one interval.

A run is a sequence of intervals of ``evaluate_every`` steps. Each interval begins with a reset. Its random
numbers depend only on the seed and its number, so a run that is killed and resumed has the same weights at
the end, bit for bit, as an uninterrupted one (on the same processor and versions).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from imujoco_minari.errors import TrainingError
from imujoco_minari.policies import Array
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.references import CONFIRMING_SEED, random_evaluation
from imujoco_minari.policies.rollouts import episode_seed
from imujoco_minari.training.agents import (
    ALGORITHM,
    actor_arrays,
    actor_of,
    agent_actor,
    agent_arrays,
    forget_compiled,
    load_arrays,
    make_agent,
    restore_agent,
    save_arrays,
)
from imujoco_minari.training.anchored_updates import anchored_updates
from imujoco_minari.training.hyperparameters import SCRATCH
from imujoco_minari.training.task import Task
from imujoco_minari.variants import BASE

# Base seeds of the evaluations that rank and choose. They differ from the default seed of datasets, 0.
RANKING_SEED, CHOOSING_SEED = 1_000_001, 1_000_002
# A second evaluation follows unless the mean is below the best score by more than this share of it.
_SECOND_EVALUATION_MARGIN = 0.02


@dataclass
class Progress:
    """The progress of a run, stored with every checkpoint.

    Attributes:
        intervals: intervals done.
        steps: environment steps done.
        updates: gradient steps done.
        wall_seconds: wall time in seconds, evaluations included.
        best: evaluation of the best actor over the deciding episodes; empty before the first actor.
        best_steps: environment steps at which the best actor was found.
        evaluations: one entry for each evaluated interval.
        episodes: number of training episodes begun. It seeds the next episode.
    """

    intervals: int = 0
    steps: int = 0
    updates: int = 0
    wall_seconds: float = 0.0
    best: dict[str, Any] = field(default_factory=dict)
    best_steps: int = 0
    evaluations: list[dict[str, Any]] = field(default_factory=list)
    episodes: int = 0

    @property
    def best_score(self) -> float:
        """Score of the best actor; -inf before the first actor."""
        return score(self.best) if self.best else float("-inf")


def score(evaluation: Mapping[str, Any]) -> float:
    """Return the mean of mean and lowest return. It is low for a policy that falls now and then."""
    return float(evaluation["return_mean"] + evaluation["return_min"]) / 2


# Called after every interval.
OnInterval = Callable[[Progress, Task], None]


def do_nothing(progress: Progress, task: Task) -> None:
    """Do nothing after an interval."""


class SeededResets(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper that seeds every reset from the number of the episode and ignores the caller's seed."""

    def __init__(self, env: gym.Env[Any, Any], seed: int) -> None:
        super().__init__(env)
        self._seed = seed
        self.episodes = 0

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Reset with the next seed."""
        kwargs["seed"] = episode_seed(self._seed, self.episodes)
        self.episodes += 1
        return self.env.reset(**kwargs)


class Run:
    """A training run in a state folder. A run whose folder has a checkpoint is resumed.

    Args:
        task: the description of the run.
        folder: state of this run alone; created if it does not exist.
        wrap: wraps the training environment, for example to record it.
        device: see :func:`~imujoco_minari.training.agents.make_agent`.
    """

    def __init__(
        self,
        task: Task,
        folder: Path,
        wrap: Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] = lambda env: env,
        device: str | None = None,
    ) -> None:
        self.task, self.folder, self.progress = task, folder, Progress()
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "ladder").mkdir(exist_ok=True)
        self._env = SeededResets(wrap(task.environment()), task.seed)
        self._evaluation_env = task.environment()
        self._device = device
        self._checkpoint_file = folder / _CHECKPOINT_NAME
        arrays = load_arrays(self._checkpoint_file) if self._checkpoint_file.is_file() else {}
        if arrays:
            self.progress = _stored_progress(arrays)
        self._agent = self._new_agent()
        if arrays:
            self._load_checkpoint(arrays)
        elif task.agent:
            restore_agent(self._agent, task.agent)
        if task.agent and task.settings.anchor:
            # What the run began as holds it, also after it was resumed.
            self._agent._train = anchored_updates(agent_actor(task.agent), task.settings.anchor)

    def train(self, on_interval: OnInterval = do_nothing) -> dict[str, Any]:
        """Train until the target or the last step and return the record of the best actor.

        Args:
            on_interval: called with the progress and the task after every interval.
        """
        if self.task.agent and not self.progress.intervals:
            self._evaluate_actor(time.monotonic())
        while not self.finished:
            self.train_interval()
            on_interval(self.progress, self.task)
        return self._make_record()

    @property
    def finished(self) -> bool:
        """Whether the run has reached its target or its last step."""
        return (
            self.progress.best_score >= self.task.target
            or self.progress.steps >= self.task.settings.max_steps
        )

    def close(self) -> None:
        """Close the environments and free the agent."""
        self._env.close()
        self._evaluation_env.close()
        self._agent = None
        forget_compiled()

    def _new_agent(self) -> Any:
        """Return a new agent with the learning rate of the present step."""
        self._learning_rate = self.task.settings.rate(self.progress.steps)
        settings = replace(self.task.settings, learning_rate=self._learning_rate)
        return make_agent(self._env, settings, self.task.seed, self._device)

    def _change_learning_rate(self) -> None:
        """Replace the agent by a copy with the present learning rate, which an agent cannot change."""
        before, self._agent = self._agent, self._new_agent()
        restore_agent(self._agent, agent_arrays(before))
        if "_train" in vars(before):
            self._agent._train = before._train
        self._agent.replay_buffer = before.replay_buffer
        self._agent.num_timesteps, self._agent._n_updates = before.num_timesteps, before._n_updates

    def train_interval(self) -> None:
        """Train for one interval, evaluate the actor and write a checkpoint."""
        begin = time.monotonic()
        settings, progress = self.task.settings, self.progress
        if self._learning_rate != settings.rate(progress.steps):
            self._change_learning_rate()
        agent = self._agent
        # Stable-Baselines3 samples its replay buffer with NumPy's global generator.
        np.random.seed(episode_seed(self.task.seed, 1_000_000 + progress.intervals))
        agent.action_space.seed(episode_seed(self.task.seed, 2_000_000 + progress.intervals))
        exploring = progress.steps < settings.exploration_steps
        agent.learning_starts = settings.exploration_steps if self.task.start == SCRATCH else 0
        agent.gradient_steps = 0 if exploring else settings.updates_per_call
        agent._last_obs = None
        steps = settings.evaluate_every
        if exploring:
            steps = min(steps, settings.exploration_steps - progress.steps)
        agent.learn(steps, reset_num_timesteps=agent.num_timesteps == 0)
        progress.intervals += 1
        progress.steps, progress.updates = int(agent.num_timesteps), int(agent._n_updates)
        progress.episodes = self._env.episodes
        # A run that ends before its first update has the actor that it began with.
        if not exploring or self.finished:
            self._evaluate_actor(begin)
        else:
            progress.wall_seconds += time.monotonic() - begin
        self._save_checkpoint()

    def _evaluate_actor(self, begin: float) -> None:
        """Evaluate the actor at its stored precision; save it as a checkpoint, and as the best if it is."""
        progress, settings = self.progress, self.task.settings
        arrays = actor_arrays(self._agent)
        ranked = self._evaluate(arrays, settings.ranking_episodes, RANKING_SEED)
        save_arrays(self.folder / "ladder" / f"{progress.steps}.safetensors", arrays)
        # Not a multiple of the best score, which may be negative.
        needed = progress.best_score - _SECOND_EVALUATION_MARGIN * abs(progress.best_score)
        if ranked["return_mean"] >= needed and (better := self._better_evaluation(arrays)):
            progress.best, progress.best_steps = better, progress.steps
            save_arrays(self.folder / "best.safetensors", arrays)
            if self.task.variant.category == BASE:
                # The base's variants start from this agent.
                save_arrays(self.folder / "best-agent.safetensors", agent_arrays(self._agent))
        progress.wall_seconds += time.monotonic() - begin
        progress.evaluations.append({"steps": progress.steps} | ranked)

    def _better_evaluation(self, arrays: dict[str, Array]) -> dict[str, Any]:
        """Return the evaluation over the deciding episodes, or nothing if the actor is not the best."""
        evaluation: dict[str, Any] = {}
        for episodes in (self.task.settings.choosing_episodes, self.task.settings.deciding_episodes):
            evaluation = self._evaluate(arrays, episodes, CHOOSING_SEED)
            if score(evaluation) <= self.progress.best_score:
                return {}
        return evaluation

    def _evaluate(self, arrays: dict[str, Array], episodes: int, seed: int) -> dict[str, Any]:
        actor = actor_of(arrays, self.task.variant.robot)
        return evaluate(self._evaluation_env, actor, episodes=episodes, seed=seed).asdict()

    def _save_checkpoint(self) -> None:
        buffer = self._agent.replay_buffer
        filled = buffer.buffer_size if buffer.full else buffer.pos
        # One file, replaced in one step, so agent, buffer and progress are always of the same interval.
        save_arrays(
            self._checkpoint_file,
            {f"agent/{name}": array for name, array in agent_arrays(self._agent).items()}
            | {f"buffer/{name}": getattr(buffer, name)[:filled].astype(np.float32) for name in _BUFFER_ARRAYS}
            | {
                "position": np.array([buffer.pos, int(buffer.full)]),
                "progress": np.frombuffer(json.dumps(vars(self.progress)).encode(), dtype=np.uint8),
            },
        )

    def _load_checkpoint(self, arrays: dict[str, Array]) -> None:
        restore_agent(self._agent, _strip_prefix("agent/", arrays))
        buffer = self._agent.replay_buffer
        for name, array in _strip_prefix("buffer/", arrays).items():
            getattr(buffer, name)[: len(array)] = array
        buffer.pos, buffer.full = int(arrays["position"][0]), bool(arrays["position"][1])
        self._agent.num_timesteps, self._agent._n_updates = self.progress.steps, self.progress.updates
        self._env.episodes = self.progress.episodes

    def _make_record(self) -> dict[str, Any]:
        """Evaluate the best actor on seeds that did not select it, and return its record."""
        task, progress = self.task, self.progress
        arrays = load_arrays(self.folder / "best.safetensors")
        confirmed = self._evaluate(arrays, task.settings.confirming_episodes, CONFIRMING_SEED)
        return {
            "variant": str(task.variant),
            "algorithm": ALGORITHM,
            "library": f"sbx-rl {version('sbx-rl')}",
            "start": task.start,
            "start_sha256": task.start_sha256,
            "steps": progress.best_steps,
            "steps_trained": progress.steps,
            "updates": progress.updates,
            "seed": task.seed,
            "hyperparameters": task.settings.asdict(),
            "wall_seconds": round(progress.wall_seconds, 1),
            "versions": {name: version(name) for name in ("mujoco", "gymnasium", "jax", "sbx-rl", "numpy")},
            "weights_sha256": actor_of(arrays, task.variant.robot).sha256,
            "selection": progress.best,
            "evaluation": confirmed,
            "random": random_evaluation(task.variant),
        }


_CHECKPOINT_NAME = "checkpoint.safetensors"
_BUFFER_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def load_progress(folder: Path) -> Progress:
    """Return the progress in the last checkpoint of a state folder.

    It is empty if there is no checkpoint: the run's first actor had reached the target.
    """
    checkpoint = folder / _CHECKPOINT_NAME
    return _stored_progress(load_arrays(checkpoint)) if checkpoint.is_file() else Progress()


def _stored_progress(checkpoint: dict[str, Array]) -> Progress:
    try:
        return Progress(**json.loads(checkpoint["progress"].tobytes()))
    except TypeError:
        raise TrainingError(
            "the unfinished run is of another version of this package: remove its state folder"
        ) from None


def _strip_prefix(prefix: str, arrays: dict[str, Array]) -> dict[str, Array]:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
