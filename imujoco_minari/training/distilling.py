"""Distils many policies of a robot into its universal policy, by DAgger (Ross et al. 2011).

The student acts in every variant, and the variant's teacher labels the observations that the student sees.
A teacher is the best policy that is known for a variant. Distilling takes minutes, so it is not resumed: a
run that is killed begins again and ends with the same weights.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from imujoco_minari.policies import Actor, Array
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.rungs import share_of
from imujoco_minari.training.agents import as_stored, import_jax
from imujoco_minari.training.lanes import Lanes
from imujoco_minari.training.updates import actor_outputs
from imujoco_minari.variants import Variant

# Seed of the episodes that choose teachers.
TEACHER_SEED = 1_000_006
# The weight of the log deviation in the loss. The mode alone decides deterministic actions.
_LOG_STD_WEIGHT = 0.1
_NOISE = 0.1


@dataclass(frozen=True)
class Distilling:
    """The settings of a distillation.

    Attributes:
        rounds: rounds in which the student acts.
        steps: environment steps in each variant and round.
        updates: gradient steps in each round; the last has four times as many.
        batch_size: observations in each gradient step.
        learning_rate: at the beginning of each round. It falls to a fifth, in the last round to a hundredth.
        seed: of all that is random.
    """

    rounds: int = 10
    steps: int = 1000
    updates: int = 8000
    batch_size: int = 512
    learning_rate: float = 1e-3
    seed: int = 0


class Lesson(NamedTuple):
    """A variant and the policy that teaches it.

    Attributes:
        variant: the variant.
        teacher: an actor of the observation alone.
        share: its mean return as a share of the base expert's.
    """

    variant: Variant
    teacher: Actor
    share: float


def best_teacher(variant: Variant, candidates: Sequence[Actor], expert: Mapping[str, Any]) -> Lesson:
    """Return the best of several policies for a variant: by one episode, then the best three by four.

    Its share is of the return of the base's expert with this record.
    """

    def returns(policy: Actor, episodes: int) -> float:
        return evaluate(variant, policy, episodes=episodes, seed=TEACHER_SEED).return_mean

    if len(candidates) > 3:
        candidates = sorted(candidates, key=lambda policy: returns(policy, 1), reverse=True)[:3]
    measured = [returns(policy, 4) for policy in candidates]
    best = int(np.argmax(measured))
    return Lesson(variant, candidates[best], share_of(measured[best], expert))


def distil(
    lessons: Sequence[Lesson],
    start: Actor,
    settings: Distilling,
    say: Callable[[str], None] = lambda line: None,
) -> dict[str, Array]:
    """Return the weights (Stable-Baselines3's names) of a universal policy that acts as the teachers do.

    The lessons are variants of one robot. The student begins as ``start``, an actor of observation and
    context. ``say`` is called with a line about each round.
    """
    begin, rng = time.monotonic(), np.random.default_rng(settings.seed)
    variants, teachers = [lesson.variant for lesson in lessons], [lesson.teacher for lesson in lessons]
    size = teachers[0].observation_size
    lanes = Lanes(
        variants[0].robot, len(lessons), lambda lane, episode: variants[lane], settings.seed, told=True
    )
    student = Student(start, settings)
    # The inputs of each recording, and the teachers' modes and log deviations for them.
    seen: list[Array] = []
    labels: list[Array] = []

    def record(act: Callable[[Array], Array]) -> Array:
        """Act in every variant, remember what was seen, and return the mean rewards."""
        lanes.restart()
        inputs, rewards = [], np.zeros(len(lessons))
        for _ in range(settings.steps):
            inputs.append(lanes.inputs)
            rewards += lanes.step(np.clip(act(inputs[-1]), -1, 1)).rewards
        for lane, teacher in enumerate(teachers):
            seen.append(np.array([rows[lane] for rows in inputs]))
            mean, log_std = teacher.distribution(seen[-1][:, :size])
            labels.append(np.concatenate([np.tanh(mean), log_std], axis=1))
        return rewards / settings.steps

    def taught(inputs: Array, noise: float = 0.0) -> Array:
        rows = zip(teachers, inputs[:, :size], strict=True)
        modes = np.array([np.tanh(teacher.distribution(row)[0]) for teacher, row in rows])
        return modes + noise * rng.standard_normal(modes.shape)

    wanted = record(taught)
    record(partial(taught, noise=_NOISE))
    for number in range(1, settings.rounds + 1):
        last = number == settings.rounds
        updates = settings.updates * (4 if last else 1)
        memory = np.concatenate(seen), np.concatenate(labels)
        student.learn(*memory, rng, updates, settings.learning_rate / (100 if last else 5))
        reward, minutes = record(student.act).mean(), (time.monotonic() - begin) / 60
        say(f"round {number}: mean reward {reward:.3f}, teachers' {wanted.mean():.3f}, {minutes:.1f} min")
    lanes.close()
    return student.weights()


class Student:
    """The weights that learn, in JAX."""

    def __init__(self, start: Actor, settings: Distilling) -> None:
        jax = import_jax()
        import jax.numpy as jnp
        import optax

        self._params = {name: np.array(array, np.float32) for name, array in start.weights.items()}
        self._batch, self._rate = settings.batch_size, settings.learning_rate
        optimiser = optax.inject_hyperparams(optax.adam)(learning_rate=self._rate)
        self._state = optimiser.init(self._params)

        def loss(params: Any, inputs: Any, labels: Any) -> Any:
            mode, log_std = actor_outputs(params, inputs)
            wanted, wanted_log_std = jnp.split(labels, 2, axis=1)
            return ((mode - wanted) ** 2).mean() + _LOG_STD_WEIGHT * ((log_std - wanted_log_std) ** 2).mean()

        def update(carry: Any, batch: Any) -> tuple[Any, Any]:
            params, state = carry
            inputs, labels, rate = batch
            value, gradient = jax.value_and_grad(loss)(params, inputs, labels)
            state.hyperparams["learning_rate"] = rate
            changes, state = optimiser.update(gradient, state)
            return (optax.apply_updates(params, changes), state), value

        self._updates = jax.jit(lambda carry, batches: jax.lax.scan(update, carry, batches))
        self._forward = jax.jit(actor_outputs)

    def learn(
        self, inputs: Array, labels: Array, rng: np.random.Generator, updates: int, last_rate: float
    ) -> None:
        """Make gradient steps, with a rate that falls to ``last_rate``."""
        rates = np.geomspace(self._rate, last_rate, updates).astype(np.float32)
        for piece in np.split(rates, range(250, updates, 250)):
            chosen = rng.integers(len(inputs), size=(len(piece), self._batch))
            (self._params, self._state), _ = self._updates(
                (self._params, self._state), (inputs[chosen], labels[chosen], piece)
            )

    def act(self, inputs: Array) -> Array:
        """Return the modes, in [-1, 1], for observations and contexts."""
        return np.asarray(self._forward(self._params, inputs.astype(np.float32))[0])

    def weights(self) -> dict[str, Array]:
        """Return the weights as float16, the precision that is stored."""
        return as_stored(self._params)
