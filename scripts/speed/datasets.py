"""Benchmarks of combining, loading and sampling, against Minari and against copying the bytes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import minari
import numpy as np
import torch

from imujoco_minari.exporting.adapters import to_d3rlpy, to_torchrl
from imujoco_minari.loading import (
    STEP_ARRAYS,
    Arrays,
    Sampler,
    arrays,
    episode_batches,
    transition_samples,
)
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.storage import file_format, minari_root
from scripts.speed.measuring import LIMIT, OURS, STOCK, Row, ratio, take_turns, times


def combining_row(ids: list[str], rounds: int) -> Row:
    """Measure combining twenty datasets against ``minari.combine_datasets`` and ``cp``."""
    loaded = [minari.load_dataset(dataset_id) for dataset_id in ids]
    files = [file_format.main_file(dataset.storage.data_path) for dataset in loaded]
    episodes = sum(dataset.total_episodes for dataset in loaded)
    folder = minari_root.datasets_root() / "combined"

    def clear() -> None:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        # Pending writes of the previous contender would delay the sync of this one.
        os.sync()

    def copy() -> None:
        with (folder / "copied.bin").open("wb") as target:
            for file in files:
                with file.open("rb") as source:
                    shutil.copyfileobj(source, target, 2**20)
            # Combining syncs its file to the disk too.
            target.flush()
            os.fsync(target.fileno())

    contenders = {
        OURS: partial(combine_datasets, ids, "combined/copied-v0"),
        "link": partial(combine_datasets, ids, "combined/linked-v0", link=True),
        STOCK: partial(minari.combine_datasets, loaded, "combined/stock-v0"),
        LIMIT: copy,
    }
    seconds = take_turns(contenders, rounds, before=clear)
    clear()
    return Row(
        f"combine {len(ids)} datasets of {episodes // len(ids)} episodes",
        times(seconds),
        "s",
        {
            "times stock": ratio(seconds[STOCK], seconds[OURS]),
            "times cp": ratio(seconds[OURS], seconds[LIMIT]),
            "link, ms per episode": times(seconds)["link"] / episodes * 1000,
        },
        {
            "times stock": ("least", 4.0),
            "link, ms per episode": ("most", 0.1),
        },
        "limit is cp with fsync, since combining syncs too",
    )


_LOADS = {
    "base": "import minari; from imujoco_minari.loading import arrays; size = 0",
    OURS: "from imujoco_minari.loading import arrays; a = arrays(ids); size = len(a)",
    STOCK: "from scripts.speed.datasets import stock_load; a = stock_load(ids); size = len(a[0])",
}


def loading_row(ids: list[str], rounds: int) -> Row:
    """Measure loading datasets into arrays against iterating with Minari and ``np.load``."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        whole = arrays(ids)
        size = sum(getattr(whole, key).nbytes for key in STEP_ARRAYS)
        for key in STEP_ARRAYS:
            np.save(folder / f"{key}.npy", getattr(whole, key))
        del whole
        seconds = take_turns(
            {
                OURS: lambda: arrays(ids),
                STOCK: lambda: stock_load(ids),
                LIMIT: lambda: [np.load(folder / f"{key}.npy") for key in STEP_ARRAYS],
            },
            rounds,
        )
    memory = {name: _measure_peak_memory(code, ids) for name, code in _LOADS.items()}
    return Row(
        f"load {len(ids)} datasets into arrays ({size / 2**20:.0f} MB)",
        times(seconds),
        "s",
        {
            "times stock": ratio(seconds[STOCK], seconds[OURS]),
            "times np.load": ratio(seconds[OURS], seconds[LIMIT]),
            "peak memory to the arrays": (memory[OURS] - memory["base"]) / size,
            "the same, stock": (memory[STOCK] - memory["base"]) / size,
        },
        {"times stock": ("least", 3.0), "peak memory to the arrays": ("most", 1.3)},
        "stock iterates and concatenates, including next observations",
    )


def stock_load(ids: list[str]) -> tuple[Any, ...]:
    """Load datasets without this package: iterate with Minari and concatenate."""
    columns: dict[str, list[Any]] = {key: [] for key in STEP_ARRAYS}
    for number, dataset_id in enumerate(ids):
        for episode in minari.load_dataset(dataset_id).iterate_episodes():
            columns["observations"].append(episode.observations[:-1])
            columns["next_observations"].append(episode.observations[1:])
            columns["actions"].append(episode.actions)
            columns["rewards"].append(episode.rewards)
            columns["terminations"].append(episode.terminations)
            columns["truncations"].append(episode.truncations)
            columns["variant_index"].append(np.full(len(episode.rewards), number))
    return tuple(np.concatenate(parts) for parts in columns.values())


def _measure_peak_memory(code: str, ids: list[str]) -> int:
    """Return the peak resident memory in bytes of a process that runs ``code``."""
    script = f"ids = {ids!r}\n{code}\nfrom scripts.speed.measuring import peak_memory\nprint(peak_memory())"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return int(done.stdout.split()[-1])


def sampling_rows(ids: list[str], rounds: int) -> list[Row]:
    """Measure drawing batches from loaded arrays against the installed peers."""
    data = arrays(ids, dtype=np.float32)
    return [_transitions_row(data, ids, rounds), _episodes_row(data, ids, rounds)]


def _transitions_row(data: Arrays, ids: list[str], rounds: int) -> Row:
    batches = 1000
    dataset = minari.load_dataset(ids[0])
    rng = np.random.default_rng(0)
    stream = transition_samples(data, 256)

    def indexing() -> None:
        for _ in range(batches):
            rows = rng.integers(len(data), size=256)
            for key in STEP_ARRAYS:
                getattr(data, key)[rows]

    def minari_sampling() -> None:
        # Minari samples whole episodes. A batch of transitions is drawn from five of them.
        for _ in range(batches // 20):
            episodes = dataset.sample_episodes(5)
            pool = np.concatenate([episode.observations[:-1] for episode in episodes])
            pool[rng.integers(len(pool), size=256)]

    def sampling(sample: Callable[[], Any], share: int = 1) -> Callable[[], None]:
        def run() -> None:
            for _ in range(batches // share):
                sample()

        return run

    # Slow peers do a twentieth of the work, and their times are multiplied by twenty.
    slow = {"minari": minari_sampling}
    peers = {"SB3's buffer": sampling(partial(_sb3_buffer(data).sample, 256))}
    missing = []
    if find_spec("torchrl"):
        peers["TorchRL"] = sampling(to_torchrl(data, batch_size=256).sample)
    else:
        missing.append("TorchRL")
    if find_spec("d3rlpy"):
        slow["d3rlpy"] = sampling(partial(to_d3rlpy(data).sample_transition_batch, 256), 20)
    else:
        missing.append("d3rlpy")
    seconds = take_turns({OURS: sampling(partial(next, stream)), **peers, **slow, LIMIT: indexing}, rounds)
    for name in slow:
        seconds[name] = [value * 20 for value in seconds[name]]
    best = min({**peers, **slow}, key=lambda name: ratio(seconds[name], seconds[OURS]))
    return Row(
        "batches of 256 transitions",
        times(seconds, 1e6 / batches),
        "us per batch",
        {f"times {name}": ratio(seconds[name], seconds[OURS]) for name in {**peers, **slow}}
        | {
            "times the best peer": ratio(seconds[best], seconds[OURS]),
            "times indexing": ratio(seconds[OURS], seconds[LIMIT]),
        },
        notes=f"of {len(data):,}; the best peer is {best}; SB3 and TorchRL give torch tensors"
        + (f"; not installed here: {', '.join(missing)}" if missing else ""),
    )


def _sb3_buffer(data: Arrays) -> Any:
    import gymnasium as gym
    from stable_baselines3.common.buffers import ReplayBuffer

    box = gym.spaces.Box(-np.inf, np.inf, data.observations.shape[1:], np.float32)
    action_box = gym.spaces.Box(-1, 1, data.actions.shape[1:], np.float32)
    buffer = ReplayBuffer(len(data), box, action_box, device="cpu")
    buffer.observations[:, 0], buffer.next_observations[:, 0] = data.observations, data.next_observations
    buffer.actions[:, 0], buffer.rewards[:, 0] = data.actions, data.rewards
    buffer.dones[:, 0] = data.terminations
    buffer.full = True
    return buffer


def _episodes_row(data: Arrays, ids: list[str], rounds: int) -> Row:
    batches = 20
    dataset = minari.load_dataset(ids[0])
    rng = np.random.default_rng(0)

    def ours() -> None:
        stream = episode_batches(data, 5, seed=int(rng.integers(2**31)))
        for _ in range(batches):
            next(stream)

    def stock() -> None:
        for _ in range(batches):
            dataset.sample_episodes(5)

    def copying() -> None:
        for _ in range(batches):
            for episode in rng.integers(data.episodes, size=5):
                rows = data.rows(episode)
                for key in ("observations", "actions", "rewards"):
                    getattr(data, key)[rows].copy()

    sampler = Sampler(data, portion=(0.0, 1.0), torch=True)

    def ours_as_tensors() -> None:
        for _ in range(batches):
            sampler.sample(5, 0)

    # The original's sampler reads tables whose episodes all have a thousand rows.
    tables = tuple(torch.from_numpy(array) for array in (data.observations, data.actions))
    starts = np.arange(0, data.episode_ends[data.episode_variants == 0][-1], 1000)

    def as_the_original() -> None:
        for _ in range(batches):
            drawn = rng.choice(starts, size=5, replace=False)
            for table in tables:
                torch.cat([table[start : start + 1000][None] for start in drawn])

    contenders = {
        OURS: ours,
        "Sampler": ours_as_tensors,
        STOCK: stock,
        "as the original": as_the_original,
        LIMIT: copying,
    }
    seconds = take_turns(contenders, rounds)
    return Row(
        "batches of 5 whole episodes",
        times(seconds, 1e6 / batches),
        "us per batch",
        {
            "times stock": ratio(seconds[STOCK], seconds[OURS]),
            "times copying": ratio(seconds[OURS], seconds[LIMIT]),
            "Sampler, times the original's way": ratio(seconds["as the original"], seconds["Sampler"]),
        },
        notes="stock is minari's sample_episodes, which reads the disk; the original's has no mask",
    )
