"""The one published protocol on iMuJoCo that could be read in code, repeated on our data.

HalfCheetah's variants, sorted by file name and shuffled by ``random.Random(42)``, are split 80/20. A
demonstration is a window of 100 transitions. Observations and actions are z-scored with training statistics.
The measure is the relative L2 error of the predicted actions. First-order MAML and the fine-tuning of a
pretrained network are compared by the number of windows and of gradient steps.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from imujoco_minari.benchmark.cloning import robust_statistics
from imujoco_minari.benchmark.lines import Line, data_sha256, measure_each, run_lines, versions
from imujoco_minari.benchmark.meta import variant_blocks
from imujoco_minari.benchmark.networks import (
    Initial,
    Loss,
    Network,
    cloning_loss,
    descend,
    draw_variants,
    forward,
    gradient_step,
    iterate,
    new_network,
    padded,
)
from imujoco_minari.loading import Arrays, arrays
from imujoco_minari.policies import Array
from imujoco_minari.training.agents import import_jax
from imujoco_minari.variants import catalogue

NAME = "published-2026"
FILE = "reproduction.jsonl"
CELL = ("protocol", "method", "seed")
ROBOT, WINDOW = "halfcheetah", 100
SHOTS, STEPS, SEEDS = (1, 5, 10, 25), (1, 5, 10, 25, 50, 100, 200), 5
METHODS = ("maml", "fine-tuning")
# The published errors, by steps.
PUBLISHED: Mapping[str, Mapping[int, float]] = {
    "maml": {5: 0.380, 25: 0.320, 200: 0.257},
    "fine-tuning": {5: 0.443, 25: 0.330, 200: 0.234},
}
PUBLISHED_SHOTS = 25
HIDDEN = (256, 256, 256, 256)
TASKS, META_RATE, INNER_RATE, META_SHOTS = 16, 5e-4, 0.01, (1, 3, 5)


@dataclass(frozen=True)
class Choices:
    """The choices that the published protocol leaves open, and its longest training.

    Attributes:
        meta_steps: steps of the meta-training; the protocol has 10,000.
        share: share of each variant's episodes that is used.
        pretraining_steps: steps of the pretraining.
        pretraining_batch: rows of a batch of the pretraining.
        tuning_rate: learning rate of the fine-tuning, by Adam on all rows.
        query_windows: windows of a meta-training query.
        test_windows: windows of a held-out variant on which the error is measured.
        initial: distribution of the initial weights.
    """

    meta_steps: int = 10_000
    share: float = 0.2
    pretraining_steps: int = 20_000
    pretraining_batch: int = 512
    tuning_rate: float = 5e-4
    query_windows: int = 1
    test_windows: int = 50
    initial: Initial = "pytorch"


DEFAULT = Choices()


def published_split() -> tuple[list[str], list[str]]:
    """Return the ids of the datasets to train on and of those held out: 42 and 11."""
    ids = sorted(variant.dataset_id() for variant in catalogue(ROBOT))
    random.Random(42).shuffle(ids)
    train = int(0.8 * len(ids))
    return ids[:train], ids[train:]


def run_reproduction(
    results: Path,
    *,
    seeds: Sequence[int] = range(SEEDS),
    choices: Choices = DEFAULT,
    jobs: int = 1,
    on_cells: Callable[[int], None] = lambda cells: None,
) -> list[Line]:
    """Compute the lines that a results folder lacks, one for each method and seed, and return all of them.

    Args:
        results: folder of ``reproduction.jsonl``.
        seeds: the seeds.
        choices: the choices that the protocol leaves open.
        jobs: number of processes.
        on_cells: called with the number of lines that have become known.

    Raises:
        DatasetNotFoundError: if a dataset of HalfCheetah's variants is not in the Minari root.
        BenchmarkError: if a process was lost.
    """
    train, test = published_split()
    common = {
        "protocol": NAME,
        "settings": asdict(choices),
        "train_sha256": data_sha256(train),
        "data_sha256": data_sha256(test),
        "versions": versions(),
    }
    wanted: list[Line] = [{**common, "method": method, "seed": seed} for seed in seeds for method in METHODS]
    return run_lines(results / FILE, partial(measure_each, _run_line, jobs), wanted, on_cells)


class Comparison(NamedTuple):
    """An error of this package's data beside the published one."""

    method: str
    windows: int
    steps: int
    error: float
    std: float
    published: float | None


def comparison(lines: Sequence[Line]) -> list[Comparison]:
    """Return the mean errors over the seeds of the lines, and their standard deviations."""
    rows = []
    for method, shots, steps in product(METHODS, SHOTS, STEPS):
        errors = [line["results"][str(shots)][str(steps)] for line in lines if line["method"] == method]
        if errors:
            mean, std = float(np.mean(errors)), float(np.std(errors))
            published = PUBLISHED[method].get(steps) if shots == PUBLISHED_SHOTS else None
            rows.append(Comparison(method, shots, steps, mean, std, published))
    return rows


def _run_line(line: Line) -> Line:
    choices = Choices(**line["settings"])
    train, test = (arrays(ids, portion=(0.0, choices.share), dtype=np.float32) for ids in published_split())
    of_inputs, of_targets = robust_statistics(train.observations), robust_statistics(train.actions)

    def scaled(data: Arrays, rows: Any = slice(None)) -> tuple[Array, Array]:
        return of_inputs.normalize(data.observations[rows]), of_targets.normalize(data.actions[rows])

    inputs, targets = scaled(train)
    sizes = (inputs.shape[1], *HIDDEN, targets.shape[1])
    network = new_network(sizes, line["seed"], choices.initial)
    data: tuple[Any, ...] = (padded(inputs), padded(targets))
    if line["method"] == "maml":
        steps, loss = choices.meta_steps, _meta_loss(choices.query_windows)
        data += variant_blocks(train)
    else:
        steps, loss = choices.pretraining_steps, cloning_loss(choices.pretraining_batch, _squared)
        data += (len(inputs),)
    network = descend(loss, network, data, [steps], rate=META_RATE, seed=line["seed"])[steps]
    errors: dict[str, dict[str, list[float]]] = {}
    rng = np.random.default_rng(line["seed"])
    for start, count in zip(*variant_blocks(test), strict=True):
        windows = start + WINDOW * rng.permutation(count // WINDOW)
        asked = scaled(test, _rows(windows[-choices.test_windows :]))
        for shots in SHOTS:
            support = scaled(test, _rows(windows[:shots]))
            for steps, adapted in _adapted(line["method"], network, support, choices.tuning_rate).items():
                error = np.linalg.norm(forward(adapted, asked[0]) - asked[1]) / np.linalg.norm(asked[1])
                errors.setdefault(str(shots), {}).setdefault(str(steps), []).append(float(error))
    means = {
        shots: {steps: round(float(np.mean(found)), 4) for steps, found in by_steps.items()}
        for shots, by_steps in errors.items()
    }
    return {**line, "results": means}


def _rows(windows: Array) -> Array:
    return (windows[:, None] + np.arange(WINDOW)).ravel()


def _adapted(
    method: str, network: Network, support: tuple[Array, Array], tuning_rate: float
) -> dict[int, Network]:
    """Return the network after each number of steps, each on all rows of the support windows."""
    if method == "maml":
        return iterate(_inner_step, network, support, STEPS, 0)
    return descend(_whole_loss, network, support, STEPS, rate=tuning_rate, seed=0)


def _squared(network: Network, inputs: Any, targets: Any) -> Any:
    return ((forward(network, inputs) - targets) ** 2).mean()


def _whole_loss(network: Network, key: Any, data: tuple[Any, ...]) -> Any:
    return _squared(network, *data)


def _inner_step(network: Network, key: Any, data: tuple[Any, ...]) -> Network:
    adapted: Network = gradient_step(network, lambda own: _squared(own, *data), INNER_RATE)
    return adapted


@cache
def _meta_loss(query_windows: int) -> Loss:
    """Return the loss of first-order MAML: one inner step on 1, 3 or 5 windows of each of 16 variants."""
    jax = import_jax()
    jnp = jax.numpy
    most = max(META_SHOTS)

    def loss(network: Network, key: Any, data: tuple[Any, ...]) -> Any:
        inputs, targets, starts, counts = data
        drawing, many = jax.random.split(key)
        chosen, windows = draw_variants(
            drawing, jnp.zeros_like(starts), counts // WINDOW, TASKS, most + query_windows
        )
        rows = starts[chosen][:, None, None] + WINDOW * windows[:, :, None] + jnp.arange(WINDOW)
        shots = jax.random.choice(many, jnp.array(META_SHOTS), (TASKS,))

        def after_adapting(support: Any, query: Any, shots: Any) -> Any:
            # Windows beyond the number that is drawn have no weight.
            weight = (jnp.arange(most) < shots) / shots

            def inner(network: Network) -> Any:
                errors = (forward(network, inputs[support]) - targets[support]) ** 2
                return (weight * errors.mean(axis=(1, 2))).sum()

            adapted = gradient_step(network, inner, INNER_RATE)
            return _squared(adapted, inputs[query], targets[query])

        return jax.vmap(after_adapting)(rows[:, :most], rows[:, most:], shots).mean()

    return loss
