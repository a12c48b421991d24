"""Trains a universal policy further, by CrossQ over many variants, held near the policy that it began as.

The policy and the critics take the observation and the context. To the actor's loss is added
``mean|Q| / alpha`` times the squared distance between its mode and that of the *anchor*, the policy at the
beginning, as TD3+BC holds a policy to data (Fujimoto and Gu 2021). Without it the policy first falls.

A run writes a checkpoint after each interval: the agent, without the buffer. A run that is resumed fills the
buffer again with its present policy.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from imujoco_minari.envs.registration import make
from imujoco_minari.policies import Array
from imujoco_minari.policies.rollouts import episode_seed
from imujoco_minari.policies.universal import whole_context
from imujoco_minari.training.agents import (
    actor_arrays,
    agent_arrays,
    load_arrays,
    make_agent,
    replace_actor,
    restore_agent,
    save_arrays,
)
from imujoco_minari.training.anchored_updates import (
    CRITICS,
    TransitionBuffer,
    anchored_updates,
    compiled_act,
    rate_setter,
    with_context,
)
from imujoco_minari.training.hyperparameters import IMPROVE, hyperparameters
from imujoco_minari.variants import Variant, specification

_LANES = 20
_UPDATES = 9
# A policy delay that no number of updates reaches: only the critics learn.
_NEVER = 10**9


@dataclass(frozen=True)
class Anchored:
    """The settings of a run.

    Attributes:
        alpha: how far the policy may go from the anchor; larger is further.
        steps: environment steps.
        critic_updates: updates of the critics alone at the beginning.
        learning_rate: of actor, critics and entropy coefficient.
        last_rate: learning rate of the last quarter of the steps.
        batch_size: transitions in each update.
        buffer_size: transitions that are kept.
        interval: steps between two evaluations. Each evaluation is a checkpoint too.
        average: share that the averaged weights keep at each interval.
        drawn: share of the episodes whose variant is drawn, not listed.
        filling: steps in each listed variant, twice, that fill the buffer before the first update.
        seed: of all that is random.
    """

    alpha: float = 20.0
    steps: int = 1_000_000
    critic_updates: int = 20_000
    learning_rate: float = 3e-4
    last_rate: float = 5e-5
    batch_size: int = 256
    buffer_size: int = 1_000_000
    interval: int = 50_000
    average: float = 0.7
    drawn: float = 0.5
    filling: int = 1000
    seed: int = 0


@dataclass
class AnchoredProgress:
    """The progress of a run, stored with every checkpoint.

    Attributes:
        steps: environment steps done.
        seconds: wall time.
        best: mean share of the best actor, of the present or the averaged weights.
        evaluations: one entry for each interval.
        running: variant -> running share of its training episodes.
        episodes: number of training episodes begun.
    """

    steps: int = 0
    seconds: float = 0.0
    best: float = float("-inf")
    evaluations: list[dict[str, Any]] = field(default_factory=list)
    running: dict[str, float] = field(default_factory=dict)
    episodes: int = 0


class AnchoredRun:
    """A run in a state folder. A run whose folder has a checkpoint is resumed.

    Args:
        wanted: listed variants of one robot, and the return that counts as 1 in each.
        draw: a seed -> a variant to train in, beside the listed ones.
        start: the weights of a universal policy, under Stable-Baselines3's names: start and anchor.
        begun_as: the arrays of the agent whose critics the critics begin as: the base's, or one that is told.
        settings: the settings.
        folder: state of this run alone.
    """

    def __init__(
        self,
        wanted: Mapping[Variant, float],
        draw: Callable[[int], Variant],
        start: Mapping[str, Array],
        begun_as: Mapping[str, Array],
        settings: Anchored,
        folder: Path,
    ) -> None:
        self.settings, self.folder, self.progress = settings, folder, AnchoredProgress()
        self._wanted, self._draw = dict(wanted), draw
        self._listed = list(wanted)
        self.robot = self._listed[0].robot
        folder.mkdir(parents=True, exist_ok=True)
        self._rng = np.random.default_rng(settings.seed)
        self._contexts = np.array([whole_context(variant) for variant in self._listed], np.float32)
        self._agent = self._new_agent(start, begun_as)
        self._average = {name: np.asarray(array, np.float32) for name, array in start.items()}
        checkpoint = folder / "checkpoint.safetensors"
        self._resumed = checkpoint.is_file()
        if self._resumed:
            arrays = load_arrays(checkpoint)
            self.progress = AnchoredProgress(**json.loads(arrays.pop("progress").tobytes()))
            self._average = {
                name.removeprefix("average/"): arrays.pop(name)
                for name in [name for name in arrays if name.startswith("average/")]
            }
            restore_agent(self._agent, arrays)
            self._rng = np.random.default_rng([settings.seed, self.progress.steps])
        self._envs = {variant: make(variant, disable_env_checker=True) for variant in self._listed}
        self._buffer = TransitionBuffer(settings.buffer_size, self._sizes)
        self._lanes: list[_Lane] = []
        self._act = compiled_act()

    @property
    def _sizes(self) -> tuple[int, int]:
        """Length of an input (observation and context) and of an action."""
        page = specification(self.robot)
        return page.observation_size + self._contexts.shape[1], page.action_size

    def train(self, on_interval: Callable[[dict[str, Any]], None] = lambda told: None) -> None:
        """Train to the last step. The best actor is in the folder then, as ``best.safetensors``."""
        begin = time.monotonic() - self.progress.seconds
        if not self.progress.evaluations:
            on_interval(self._evaluate(begin))
        self._fill()
        rate = self.settings.learning_rate
        if not self._resumed:
            self._set_rate(rate)
            for _ in range(self.settings.critic_updates // _UPDATES):
                self._update(_NEVER)
        while self.progress.steps < self.settings.steps:
            late = self.progress.steps >= 0.75 * self.settings.steps
            self._set_rate(self.settings.last_rate if late else rate)
            for _ in range(self.settings.interval // _LANES):
                self._step()
                self._update(3)
            self.progress.steps += self.settings.interval // _LANES * _LANES
            told = self._evaluate(begin)
            self._save()
            on_interval(told)

    def _new_agent(self, start: Mapping[str, Array], begun_as: Mapping[str, Array]) -> Any:
        size, actions = self._sizes
        spaces = gym.spaces.Box(-np.inf, np.inf, (size,)), gym.spaces.Box(-1, 1, (actions,))
        settings = hyperparameters(
            self.robot, IMPROVE, batch_size=self.settings.batch_size, max_steps=1, evaluate_every=1
        )
        agent = make_agent(_Spaces(*spaces), settings, self.settings.seed)
        own, observations = agent_arrays(agent), specification(self.robot).observation_size
        told = with_context(own, begun_as, self._contexts, observations)
        restore_agent(agent, replace_actor(told, dict(start)))
        self._train = anchored_updates(start, self.settings.alpha)
        self._set_rates = rate_setter(agent)
        return agent

    def _set_rate(self, rate: float) -> None:
        self._set_rates(self._agent, rate)

    def _update(self, delay: int) -> None:
        agent = self._agent
        data = self._buffer.sample(self._rng, _UPDATES * self.settings.batch_size, agent.gamma)
        agent.policy.qf_state, agent.policy.actor_state, agent.ent_coef_state, agent.key, _ = self._train(
            agent.target_entropy,
            _UPDATES,
            data,
            delay,
            1,
            agent.policy.qf_state,
            agent.policy.actor_state,
            agent.ent_coef_state,
            agent.key,
        )

    def _fill(self) -> None:
        """Fill the buffer with two sampled episodes of each listed variant, and begin the lanes."""
        for _ in range(2):
            waiting = list(self._listed)
            while waiting:
                group, waiting = waiting[:_LANES], waiting[_LANES:]
                self._lanes = [self._begin(variant) for variant in group]
                for _step in range(self.settings.filling):
                    self._step(group)
        self._lanes = [self._begin() for _ in range(_LANES)]

    def _begin(self, variant: Variant | None = None) -> _Lane:
        progress = self.progress
        progress.episodes += 1
        seed = episode_seed(self.settings.seed, progress.episodes)
        if variant is None and self._rng.random() < self.settings.drawn:
            drawn = self._draw(seed)
            env = make(drawn, disable_env_checker=True)
            told = whole_context(drawn).astype(np.float32)
            return _Lane(None, env, told, env.reset(seed=seed)[0])
        if variant is None:
            shares = np.array([progress.running.get(str(each), 0.8) for each in self._listed])
            weights = np.clip(1.1 - shares, 0.1, 0.6)
            variant = self._listed[int(self._rng.choice(len(self._listed), p=weights / weights.sum()))]
        # Two lanes may be in one variant, so each has an environment of its own.
        env = make(variant, disable_env_checker=True)
        told = self._contexts[self._listed.index(variant)]
        return _Lane(variant, env, told, env.reset(seed=seed)[0])

    def _step(self, keep: Sequence[Variant] = ()) -> None:
        """Act once in every lane and store the transitions."""
        inputs = np.array([np.append(lane.observation, lane.told) for lane in self._lanes], np.float32)
        noise = self._rng.standard_normal((len(inputs), self._sizes[1])).astype(np.float32)
        actions = np.asarray(self._act(self._agent.policy.actor_state.params, inputs, noise))
        bound = specification(self.robot).action_bound
        for number, (lane, action) in enumerate(zip(self._lanes, actions, strict=True)):
            observation, reward, terminated, truncated, _ = lane.env.step(action * bound)
            self._buffer.add(
                inputs[number], np.append(observation, lane.told), action, float(reward), bool(terminated)
            )
            lane.observation, lane.total = observation, lane.total + float(reward)
            if terminated or truncated:
                if lane.variant is not None:
                    running, name = self.progress.running, str(lane.variant)
                    share = lane.total / self._wanted[lane.variant]
                    running[name] = 0.7 * running.get(name, share) + 0.3 * share
                lane.env.close()
                self._lanes[number] = self._begin(keep[number] if keep else None)

    def _evaluate(self, begin: float) -> dict[str, Any]:
        """Evaluate the present and the averaged weights, an episode a variant, and save the best."""
        present = {name: array.astype(np.float32) for name, array in actor_arrays(self._agent).items()}
        keep = self.settings.average if self.progress.steps else 0.0
        self._average = {
            name: (keep * self._average[name] + (1 - keep) * array).astype(np.float32)
            for name, array in present.items()
        }
        told: dict[str, Any] = {"steps": self.progress.steps}
        for kind, weights in (("present", present), ("average", self._average)):
            shares = self._shares(weights)
            told[kind] = {
                "median": float(np.median(shares)),
                "mean": float(shares.mean()),
                "min": float(shares.min()),
                "weakest": [str(self._listed[i]) for i in np.argsort(shares)[:3]],
            }
            score = float(np.minimum(shares, 1.1).mean())
            if score > self.progress.best:
                self.progress.best = score
                told["best"] = kind
                save_arrays(
                    self.folder / "best.safetensors",
                    {name: array.astype(np.float16) for name, array in weights.items()},
                )
        self.progress.seconds = time.monotonic() - begin
        told["seconds"] = round(self.progress.seconds)
        self.progress.evaluations.append(told)
        return told

    def _shares(self, weights: Mapping[str, Array]) -> Array:
        """Return the share of each listed variant over one deterministic episode, all stepped together."""
        envs = list(self._envs.values())
        seen = [
            env.reset(seed=episode_seed(1_000_007, number + 1000 * len(self.progress.evaluations)))[0]
            for number, env in enumerate(envs)
        ]
        totals, active = np.zeros(len(envs)), list(range(len(envs)))
        bound = specification(self.robot).action_bound
        rows = [
            (weights[f"{name}.weight"].T, weights[f"{name}.bias"])
            for name in ("latent_pi.0", "latent_pi.2", "mu")
        ]
        while active:
            x = np.concatenate(
                [np.array([seen[i] for i in active], np.float32), self._contexts[active]], axis=1
            )
            for weight, bias in rows[:-1]:
                x = np.maximum(x @ weight + bias, 0)
            actions = np.tanh(x @ rows[-1][0] + rows[-1][1]) * bound
            for i, action in zip(list(active), actions, strict=True):
                seen[i], reward, terminated, truncated, _ = envs[i].step(action)
                totals[i] += float(reward)
                if terminated or truncated:
                    active.remove(i)
        return np.asarray(totals / np.array(list(self._wanted.values())))

    def critics(self) -> dict[str, Array]:
        """Return the parts of the agent from which training can go on, beside the actor: under 1 MB."""
        return {name: array for name, array in agent_arrays(self._agent).items() if name.startswith(CRITICS)}

    def _save(self) -> None:
        text = json.dumps(asdict(self.progress)).encode()
        save_arrays(
            self.folder / "checkpoint.safetensors",
            agent_arrays(self._agent)
            | {f"average/{name}": array for name, array in self._average.items()}
            | {"progress": np.frombuffer(text, np.uint8)},
        )


@dataclass
class _Lane:
    variant: Variant | None
    env: Any
    told: Array
    observation: Array
    total: float = 0.0


class _Spaces(gym.Env[Any, Any]):
    """An environment that has spaces only: the agent is made for it."""

    def __init__(self, observations: gym.spaces.Box, actions: gym.spaces.Box) -> None:
        self.observation_space, self.action_space = observations, actions

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        return np.zeros(self.observation_space.shape, np.float32), {}
