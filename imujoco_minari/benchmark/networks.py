"""Multilayer perceptrons in JAX, and gradient descent on them.

Every method of the benchmark trains such networks. A trained policy network becomes an
:class:`~imujoco_minari.policies.Actor`, so that evaluating it needs neither JAX nor the method.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from imujoco_minari.errors import missing_dependency
from imujoco_minari.loading.statistics import Statistics
from imujoco_minari.policies import Actor, Array
from imujoco_minari.training.agents import import_jax

# One (weight (in, out), bias (out,)) for each layer.
Network = list[tuple[Any, Any]]
# A distribution of initial weights.
Initial = Literal["lecun", "pytorch"]
# Returns the loss of a network on a random batch: (network, key, data) -> scalar.
Loss = Callable[[Any, Any, Any], Any]
# A loss, the network to start from, and the loss's data.
Problem = tuple[Loss, Any, tuple[Any, ...]]
# Returns the next state of an iteration: (state, key, data) -> state.
Update = Callable[[Any, Any, Any], Any]

HIDDEN = (256, 256)
BATCH = 128
_LEAST_ROWS = 1024


def new_network(sizes: Sequence[int], seed: int, initial: Initial = "lecun") -> Network:
    """Return a network with random weights.

    Args:
        sizes: number of inputs, of units in each hidden layer, and of outputs.
        seed: seed of the weights.
        initial: distribution of the weights of a layer, which is uniform: ``lecun`` has the variance
            1 / inputs and biases of zero, ``pytorch`` has weights and biases within 1 / sqrt(inputs).
    """
    rng = np.random.default_rng(seed)
    layers = []
    for inputs, outputs in pairwise(sizes):
        limit = np.float32(((3.0 if initial == "lecun" else 1.0) / inputs) ** 0.5)
        weight = rng.uniform(-1.0, 1.0, (inputs, outputs)).astype(np.float32) * limit
        bias = np.zeros(outputs) if initial == "lecun" else rng.uniform(-limit, limit, outputs)
        layers.append((weight, bias.astype(np.float32)))
    return layers


def new_policy(inputs: Array, actions: Array, seed: int, initial: Initial = "lecun") -> Network:
    """Return a :func:`new_network` from inputs (N, in) to actions (N, act)."""
    return new_network((inputs.shape[1], *HIDDEN, actions.shape[1]), seed, initial)


def forward(network: Network, inputs: Any) -> Any:
    """Return the outputs (..., out) for inputs (..., in) of JAX or NumPy, with ReLU between the layers."""
    for weight, bias in network[:-1]:
        outputs = inputs @ weight + bias
        inputs = outputs * (outputs > 0)
    weight, bias = network[-1]
    return inputs @ weight + bias


def bind(network: Network, inputs: Array) -> Network:
    """Return a network with its last inputs, (m,), fixed: they become part of the first layer's bias."""
    (weight, bias), *rest = network
    free = len(weight) - len(inputs)
    return [(np.asarray(weight)[:free], np.asarray(bias + inputs @ weight[free:])), *rest]


def to_actor(network: Network, statistics: Statistics, algorithm: str) -> Actor:
    """Return the deterministic policy ``tanh(network(normalised observation))``.

    The statistics of the observations become part of the first layer.
    """
    (weight, bias), *rest = [(np.asarray(w, np.float64), np.asarray(b, np.float64)) for w, b in network]
    scaled = weight / statistics.std[:, None]
    layers = [(scaled, bias - statistics.mean @ scaled), *rest]
    names = [*(f"latent_pi.{2 * i}" for i in range(len(rest))), "mu"]
    weights: dict[str, Array] = {}
    for name, (w, b) in zip(names, layers, strict=True):
        weights |= {f"{name}.weight": w.T.astype(np.float32), f"{name}.bias": b.astype(np.float32)}
    # A deterministic actor does not use its deviations, but its format has them.
    weights |= {f"log_std.{part}": np.zeros_like(weights[f"mu.{part}"]) for part in ("weight", "bias")}
    return Actor(weights, algorithm)


def of_actor(actor: Actor) -> Network:
    """Return the network of an actor's mean; it takes observations that are not normalised."""
    names = [*(f"latent_pi.{2 * i}" for i in range(len(actor.hidden_sizes))), "mu"]
    return [(actor.weights[f"{name}.weight"].T, actor.weights[f"{name}.bias"]) for name in names]


def iterate(
    update: Update, state: Any, data: tuple[Any, ...], checkpoints: Sequence[int], seed: int
) -> dict[int, Any]:
    """Apply an update again and again, and return the state after each of some numbers of steps.

    Args:
        update: returns the next state. JAX compiles once for each function or equal object: use a
            function of a module, or a cached one.
        state: a tree of arrays.
        data: arrays for the update. :func:`padded` keeps the number of compiled programs small.
        checkpoints: numbers of steps; 0 gives the state itself.
        seed: seed of the keys that the update gets.
    """
    jax = import_jax()
    run = _compiled(update)
    state, key = jax.tree.map(jax.numpy.asarray, state), jax.random.key(seed)
    data = jax.tree.map(jax.numpy.asarray, data)
    found, done = {}, 0
    for checkpoint in sorted(set(checkpoints)):
        state, key = run(state, key, data, checkpoint - done)
        done = checkpoint
        found[checkpoint] = jax.tree.map(np.asarray, state)
    return found


def descend(
    loss: Loss, network: Any, data: tuple[Any, ...], checkpoints: Sequence[int], *, rate: float, seed: int
) -> dict[int, Any]:
    """Minimise a loss with Adam, and return the network after each of some numbers of steps.

    The network may be any tree of arrays that the loss takes; see :func:`iterate`.
    """
    states = iterate(_descent(loss), learner(network, rate), data, checkpoints, seed)
    return {steps: state.params for steps, state in states.items()}


def squared_error(network: Network, inputs: Any, actions: Any) -> Any:
    """Return the mean squared error of ``tanh(network(inputs))`` to the actions."""
    return ((import_jax().numpy.tanh(forward(network, inputs)) - actions) ** 2).mean()


@cache
def cloning_loss(batch: int, error: Loss = squared_error) -> Loss:
    """Return the loss of behaviour cloning on batches of some size, whose rows are drawn with replacement.

    Its data are inputs (N, in) and actions (N, act) in [-1, 1], which are padded, and N.
    """
    jax = import_jax()

    def loss(network: Network, key: Any, data: tuple[Any, ...]) -> Any:
        inputs, actions, rows = data
        chosen = jax.random.randint(key, (batch,), 0, rows)
        return error(network, inputs[chosen], actions[chosen])

    return loss


def padded(array: Array, dtype: type = np.float32) -> Array:
    """Return rows of a type, with zeros below them: the number of rows becomes a power of two."""
    size = max(_LEAST_ROWS, 1 << (len(array) - 1).bit_length())
    whole = np.zeros((size, *array.shape[1:]), dtype)
    whole[: len(array)] = array
    return whole


def learner(parameters: Any, rate: float, decay_steps: int | None = None) -> Any:
    """Return a ``TrainState`` of Flax: parameters, which are any tree of arrays, and Adam with its moments.

    The rate falls by a cosine to 0 in ``decay_steps``, or is constant.
    """
    from flax.training.train_state import TrainState

    return TrainState.create(apply_fn=None, params=parameters, tx=_adam(rate, decay_steps))


def minimised(state: Any, loss: Callable[[Any], Any]) -> Any:
    """Return the state of a :func:`learner` after one step of Adam on a loss of its parameters."""
    return state.apply_gradients(grads=import_jax().grad(loss)(state.params))


def import_optax() -> Any:
    """Return the module ``optax``.

    Raises:
        DependencyError: if JAX or Optax is not installed.
    """
    # JAX needs its settings before optax imports it.
    import_jax()
    try:
        import optax
    except ImportError:
        raise missing_dependency("optax", "train", "the benchmark") from None
    return optax


@cache
def _adam(rate: float, decay_steps: int | None) -> Any:
    # One object for each rate, because JAX compiles once for each.
    optax = import_optax()
    return optax.adam(optax.cosine_decay_schedule(rate, decay_steps) if decay_steps else rate)


def gradient_step(network: Any, loss: Callable[[Any], Any], rate: Any) -> Any:
    """Return a network after one step of plain gradient descent, through which no gradient flows."""
    jax = import_jax()
    gradient = jax.lax.stop_gradient(jax.grad(loss)(network))
    return jax.tree.map(lambda old, slope: old - rate * slope, network, gradient)


def draw_variants(key: Any, starts: Any, counts: Any, tasks: int, number: int) -> tuple[Any, Any]:
    """Return random variants (tasks,), and random rows of each (tasks, number), with replacement.

    ``starts`` has the first row of each variant, and ``counts`` its number of rows, (variants,).
    """
    jax = import_jax()
    which, where = jax.random.split(key)
    chosen = jax.random.randint(which, (tasks,), 0, len(starts))
    own = counts[chosen][:, None]
    # A share may be rounded up to 1.
    places = (jax.random.uniform(where, (tasks, number)) * own).astype(int)
    return chosen, starts[chosen][:, None] + jax.numpy.minimum(places, own - 1)


@cache
def _compiled(update: Update) -> Any:
    jax = import_jax()

    def run(state: Any, key: Any, data: Any, steps: Any) -> Any:
        def step(_: Any, carry: Any) -> Any:
            state, key = carry
            key, own = jax.random.split(key)
            return update(state, own, data), key

        return jax.lax.fori_loop(0, steps, step, (state, key))

    return jax.jit(run)


@cache
def _descent(loss: Loss) -> Update:
    return lambda state, key, data: minimised(state, lambda network: loss(network, key, data))
