"""One training run: a variant's expert, checkpointed so that a kill costs at most one interval.

A run is a sequence of intervals of ``evaluate_every`` steps. Each begins with a reset, and its random
numbers depend on the seed and its number alone; so a run that was killed and resumed ends in the same
weights, to the bit, as one that was not (on the same processor and versions).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from imujoco_minari.envs.registration import collection_spec, make
from imujoco_minari.policies import Array
from imujoco_minari.policies.references import random_evaluation
from imujoco_minari.policies.rollouts import Evaluation, episode_seed, evaluate
from imujoco_minari.training.agents import (
    actor_arrays,
    actor_of,
    agent_arrays,
    forget_compiled,
    load_arrays,
    make_agent,
    restore_agent,
    save_arrays,
)
from imujoco_minari.training.hyperparameters import SCRATCH, Hyperparameters
from imujoco_minari.variants import BASE, Variant

# Base seeds of the three kinds of evaluation episodes; none of them is a dataset's default, 0.
RANKING_SEED, CHOOSING_SEED, CONFIRMING_SEED = 1_000_001, 1_000_002, 1_000_003
# A mean must beat the best by this share before a second look is taken at it.
_SECOND_LOOK = 0.98


@dataclass(frozen=True)
class Task:
    """What to train.

    Attributes:
        variant: whose environment.
        settings: the hyperparameters.
        among: train and judge in the environments of all of these, one drawn for each episode, and not
            in ``variant``'s.
        seed: of all that is random.
        start: name of the agent that the run starts from, ``scratch`` or a base robot.
        agent: its arrays; empty from scratch.
        start_sha256: digest of that agent's actor, as its own record has it.
        target: return (mean less standard deviation, over the deciding episodes) at which to stop.
    """

    variant: Variant
    settings: Hyperparameters
    seed: int = 0
    start: str = SCRATCH
    agent: dict[str, Array] = field(default_factory=dict, repr=False)
    start_sha256: str = ""
    target: float = float("inf")
    among: tuple[Variant, ...] = ()

    @property
    def path(self) -> tuple[Variant, ...]:
        """The variants to train in, one after the other; empty when there is but one."""
        stones = self.variant.milder(self.settings.stones)
        return (*stones, self.variant) if stones else ()

    def place(self, steps: int) -> Variant | None:
        """Return the variant of the path to train in after so many steps; None when there is no path."""
        if not self.path:
            return None
        stones, approach = len(self.path) - 1, round(self.settings.approach_share * self.settings.max_steps)
        return self.path[min(stones, stones * steps // max(1, approach))]

    def environment(self, among: tuple[Variant, ...] = ()) -> gym.Env[Any, Any]:
        """Make the environment of the variant, or of several."""
        if among:
            return gym.make(collection_spec(f"{self.variant.robot}-all", among), disable_env_checker=True)
        return make(self.variant, disable_env_checker=True)


@dataclass
class Progress:
    """Where a run stands; stored with every checkpoint.

    Attributes:
        intervals: intervals done.
        steps: environment steps done.
        updates: gradient steps done.
        wall_seconds: time spent, evaluations included.
        best_score: mean less standard deviation of the best actor.
        best_steps: when the best actor was seen.
        evaluations: one entry an interval.
        episodes: environment episodes begun, which number their seeds.
    """

    intervals: int = 0
    steps: int = 0
    updates: int = 0
    wall_seconds: float = 0.0
    best_score: float = float("-inf")
    best_steps: int = 0
    evaluations: list[dict[str, Any]] = field(default_factory=list)
    episodes: int = 0


# What is called after every evaluation.
OnInterval = Callable[[Progress, Hyperparameters], None]


class SeededResets(gym.Wrapper[Any, Any, Any, Any]):
    """Give every reset a seed of its own, numbered by ``episodes``, whatever the caller asks."""

    def __init__(self, env: gym.Env[Any, Any], seed: int) -> None:
        super().__init__(env)
        self._seed = seed
        self.episodes = 0
        self.variant: Variant | None = None

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Reset with the next seed, in ``variant`` where one is set."""
        kwargs["seed"] = episode_seed(self._seed, self.episodes)
        if self.variant is not None:
            kwargs["options"] = {"variant": str(self.variant)}
        self.episodes += 1
        return self.env.reset(**kwargs)


class Run:
    """A training run in a state folder, begun or resumed.

    Args:
        task: what to train.
        folder: state of this run alone; made if need be.
        wrap: what to put around the training environment, to record it.
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
        self._env = SeededResets(wrap(task.environment(task.among or task.path)), task.seed)
        self._judge = task.environment(task.among)
        self._device = device
        self._checkpoint_file = folder / _CHECKPOINT
        arrays = load_arrays(self._checkpoint_file) if self._checkpoint_file.is_file() else {}
        if arrays:
            self.progress = Progress(**json.loads(arrays["progress"].tobytes()))
        self._agent = self._new_agent()
        if arrays:
            self._resume(arrays)
        elif task.agent:
            restore_agent(self._agent, task.agent)

    def train(self, on_interval: OnInterval | None = None) -> dict[str, Any]:
        """Train to the target or the last step, and return the record of the best actor."""
        if self.task.agent and not self.progress.intervals:
            self._judge_actor(time.monotonic())
        while not self.finished:
            self._interval()
            if on_interval is not None:
                on_interval(self.progress, self.task.settings)
        return self._record()

    @property
    def finished(self) -> bool:
        """Whether the target or the last step is reached."""
        return (
            self.progress.best_score >= self.task.target
            or self.progress.steps >= self.task.settings.max_steps
        )

    def close(self) -> None:
        """Close the environments, and let the agent go."""
        self._env.close()
        self._judge.close()
        self._agent = None
        forget_compiled()

    def _new_agent(self) -> Any:
        """Return a new agent, with the learning rate that the run's progress has."""
        self._rate = self.task.settings.rate(self.progress.steps)
        settings = replace(self.task.settings, learning_rate=self._rate)
        return make_agent(self._env, settings, self.task.seed, self._device)

    def _change_rate(self) -> None:
        """Go on with another learning rate; an agent keeps the one that it was made with."""
        before, self._agent = self._agent, self._new_agent()
        restore_agent(self._agent, agent_arrays(before))
        self._agent.replay_buffer = before.replay_buffer
        self._agent.num_timesteps, self._agent._n_updates = before.num_timesteps, before._n_updates

    def _interval(self) -> None:
        begin = time.monotonic()
        settings, progress = self.task.settings, self.progress
        if self._rate != settings.rate(progress.steps):
            self._change_rate()
        agent = self._agent
        # Stable-Baselines3 draws replay samples from NumPy's global generator.
        np.random.seed(episode_seed(self.task.seed, 1_000_000 + progress.intervals))
        agent.action_space.seed(episode_seed(self.task.seed, 2_000_000 + progress.intervals))
        exploring = progress.steps < settings.exploration_steps
        agent.learning_starts = settings.exploration_steps if self.task.start == SCRATCH else 0
        agent.gradient_steps = 0 if exploring else settings.updates_per_call
        agent._last_obs = None
        self._env.variant = self.task.place(progress.steps)
        steps = settings.evaluate_every
        if exploring:
            steps = min(steps, settings.exploration_steps - progress.steps)
        agent.learn(steps, reset_num_timesteps=agent.num_timesteps == 0)
        progress.intervals += 1
        progress.steps, progress.updates = int(agent.num_timesteps), int(agent._n_updates)
        progress.episodes = self._env.episodes
        if not exploring:
            self._judge_actor(begin)
        else:
            progress.wall_seconds += time.monotonic() - begin
        self._checkpoint()

    def _judge_actor(self, begin: float) -> None:
        """Evaluate the actor as it will be shipped, keep it as a rung, and as the best if it is that."""
        progress, settings = self.progress, self.task.settings
        arrays = actor_arrays(self._agent)
        ranked = self._evaluate(arrays, settings.ranking_episodes, RANKING_SEED)
        save_arrays(self.folder / "ladder" / f"{progress.steps}.safetensors", arrays)
        if ranked.return_mean >= _SECOND_LOOK * progress.best_score:
            score = self._score(arrays)
            if score > progress.best_score:
                progress.best_score, progress.best_steps = score, progress.steps
                save_arrays(self.folder / "best.safetensors", arrays)
                if self.task.variant.category == BASE:
                    # What its variants will start from.
                    save_arrays(self.folder / "best-agent.safetensors", agent_arrays(self._agent))
        progress.wall_seconds += time.monotonic() - begin
        progress.evaluations.append(
            {"steps": progress.steps, "best_score": progress.best_score} | ranked.asdict()
        )

    def _score(self, arrays: dict[str, Array]) -> float:
        """Return mean less deviation over the deciding episodes, or over fewer that look no better."""
        score = float("-inf")
        for episodes in (self.task.settings.choosing_episodes, self.task.settings.deciding_episodes):
            score = self._evaluate(arrays, episodes, CHOOSING_SEED).score
            if score <= self.progress.best_score:
                break
        return score

    def _evaluate(self, arrays: dict[str, Array], episodes: int, seed: int) -> Evaluation:
        actor = actor_of(arrays, self.task.settings.algorithm)
        return evaluate(self._judge, actor, episodes=episodes, seed=seed)

    def _checkpoint(self) -> None:
        buffer = self._agent.replay_buffer
        filled = buffer.buffer_size if buffer.full else buffer.pos
        # One file, replaced in one step: agent, buffer and progress are never of different intervals.
        save_arrays(
            self._checkpoint_file,
            {f"agent/{name}": array for name, array in agent_arrays(self._agent).items()}
            | {f"buffer/{name}": getattr(buffer, name)[:filled].astype(np.float32) for name in _BUFFER}
            | {
                "position": np.array([buffer.pos, int(buffer.full)]),
                "progress": np.frombuffer(json.dumps(vars(self.progress)).encode(), dtype=np.uint8),
            },
        )

    def _resume(self, arrays: dict[str, Array]) -> None:
        restore_agent(self._agent, _below("agent/", arrays))
        buffer = self._agent.replay_buffer
        for name, array in _below("buffer/", arrays).items():
            getattr(buffer, name)[: len(array)] = array
        buffer.pos, buffer.full = int(arrays["position"][0]), bool(arrays["position"][1])
        self._agent.num_timesteps, self._agent._n_updates = self.progress.steps, self.progress.updates
        self._env.episodes = self.progress.episodes

    def _record(self) -> dict[str, Any]:
        """Confirm the best actor on episodes that did not choose it, and return its record."""
        task, progress = self.task, self.progress
        arrays = load_arrays(self.folder / "best.safetensors")
        confirmed = self._evaluate(arrays, task.settings.confirming_episodes, CONFIRMING_SEED)
        return {
            "variant": str(task.variant),
            "algorithm": task.settings.algorithm,
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
            "weights_sha256": actor_of(arrays, task.settings.algorithm).sha256,
            "evaluation": confirmed.asdict(),
            "random": random_evaluation(task.variant).asdict(),
        }


_CHECKPOINT = "checkpoint.safetensors"
_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def load_progress(folder: Path) -> Progress:
    """Return where the run in a state folder stands, as of its last checkpoint."""
    arrays = load_arrays(folder / _CHECKPOINT)
    return Progress(**json.loads(arrays["progress"].tobytes()))


def _below(prefix: str, arrays: dict[str, Array]) -> dict[str, Array]:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
