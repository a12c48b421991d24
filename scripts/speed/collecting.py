"""Benchmarks of collecting, of publishing with several processes and of verification."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari

from imujoco_minari.envs.registration import environment_spec, make
from imujoco_minari.policies import Actor, expert_actor
from imujoco_minari.policies.rollouts import episode_seed
from imujoco_minari.policies.sb3 import export_zip
from imujoco_minari.publishing.collector import collect
from imujoco_minari.publishing.publisher import publish_all, publish_recipe
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.variants import ROBOTS, Variant, catalogue, specification
from imujoco_minari.verification import verify
from scripts.speed.measuring import LIMIT, OURS, STOCK, Row, rates, ratio, take_turns

# Targets of collecting: the speed relative to the stock collector and to bare stepping.
TARGETS = {"halfcheetah": (4.0, 0.75), "hopper": (2.2, 0.85), "walker2d": (2.2, 0.85)}


def collection_row(robot: str, rounds: int, steps: int) -> Row:
    """Measure collecting a dataset against the loop of Farama's generation scripts and bare stepping."""
    from stable_baselines3 import SAC

    variant = Variant.parse(f"{robot}-base")
    actor = expert_actor(variant)
    with tempfile.TemporaryDirectory() as folder:
        model = SAC.load(export_zip(variant, Path(folder) / "actor.zip", actor), device="cpu")
        length = _collect(variant, actor, 2, Path(folder) / "probe") / 2
        episodes = max(2, round(steps / length))
        total = _collect(variant, actor, episodes, Path(folder) / "ours")
        bare = _bare_stepping_loop(Path(folder) / "ours", make(variant))
        plain = _bare_stepping_loop(Path(folder) / "ours", gym.make(specification(robot).environment))
        seconds = take_turns(
            {
                OURS: lambda: _collect(variant, actor, episodes, Path(folder) / "ours"),
                STOCK: lambda: _collect_stock(specification(robot).environment, model, episodes),
                LIMIT: bare,
                "gymnasium's own environment": plain,
            },
            rounds,
        )
    # The stock loop's episodes differ by rounding, so their numbers of steps may differ too.
    stock_steps = minari.load_dataset("bench/stock-v0").total_steps
    figures = rates(seconds, total) | {STOCK: rates(seconds, stock_steps)[STOCK]}
    minari.delete_dataset("bench/stock-v0")
    times_stock, share = TARGETS[robot]
    return Row(
        f"collect {robot}, one core",
        figures,
        "steps/s",
        {
            "times stock": ratio(seconds[STOCK], seconds[OURS]) * total / stock_steps,
            "of bare stepping": ratio(seconds[LIMIT], seconds[OURS]),
        },
        {"times stock": ("least", times_stock), "of bare stepping": ("least", share)},
        f"{total / episodes:.0f} steps per episode; stock is SAC.predict and minari.DataCollector",
    )


def _collect(variant: Variant, actor: Actor, episodes: int, target: Path) -> int:
    shutil.rmtree(target, ignore_errors=True)
    collect(environment_spec(variant), actor, range(episodes), 0, target)
    with h5py.File(file_format.main_file(target)) as file:
        return sum(int(episode.attrs["total_steps"]) for episode in file.values())


def _collect_stock(environment: str, model: Any, episodes: int) -> None:
    if minari_root.exists("bench/stock-v0"):
        minari.delete_dataset("bench/stock-v0")
    collector = minari.DataCollector(gym.make(environment))
    for episode in range(episodes):
        observation, _ = collector.reset(seed=episode_seed(0, episode))
        ended = False
        while not ended:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, _ = collector.step(action)
            ended = terminated or truncated
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        collector.create_dataset("bench/stock-v0", ref_min_score=0.0, ref_max_score=1.0)
    collector.env.close()


def _bare_stepping_loop(data: Path, env: gym.Env[Any, Any]) -> Callable[[], None]:
    """Return a function that steps an environment through the recorded actions and does nothing else."""
    recorded = []
    with h5py.File(file_format.main_file(data), "r") as file:
        for number in range(len(file)):
            group = file[f"episode_{number}"]
            recorded.append((int(group.attrs["seed"]), list(group["actions"][()])))

    def run() -> None:
        for seed, actions in recorded:
            env.reset(seed=seed)
            for action in actions:
                env.step(action)

    return run


def jobs_row(rounds: int, episodes: int) -> Row:
    """Measure publishing with two processes against one, and bare stepping with two against one."""
    recipes = [Recipe(variant, episodes=episodes) for variant in catalogue("halfcheetah", "mass")]

    def work(jobs: int) -> None:
        outcomes = list(publish_all(recipes, jobs=jobs, force=True))
        assert not any(outcome.error for outcome in outcomes), outcomes

    work(1)
    data = minari_root.dataset_folder(recipes[0].dataset_id) / "data"
    with _start_bare_processes(data, 1) as bare, _start_bare_processes(data, 2) as bare_twice:
        seconds = take_turns(
            {
                "one process": lambda: work(1),
                "two processes": lambda: work(2),
                "bare, one process": bare,
                "bare, two processes": bare_twice,
            },
            rounds,
            processes=True,
        )
    steps = len(recipes) * episodes * 1000
    figures = rates(seconds, steps)
    return Row(
        f"publish {len(recipes)} variants of halfcheetah with --jobs 2",
        {name: figures[name] for name in ("two processes", "one process")},
        "steps/s",
        {
            "times one process": ratio(seconds["one process"], seconds["two processes"]),
            "bare stepping, two processes to one": 2
            * ratio(seconds["bare, one process"], seconds["bare, two processes"]),
        },
        {"times one process": ("least", 1.85)},
        "the start of the processes, digests and checks are included",
    )


_BARE_SCRIPT = """
import sys
from pathlib import Path
from scripts.speed.collecting import _bare_stepping_loop
from imujoco_minari.envs.registration import make
run = _bare_stepping_loop(Path(sys.argv[1]), make("halfcheetah-base"))
print("ready", flush=True)
for _ in sys.stdin:
    run()
    print("done", flush=True)
"""


@contextmanager
def _start_bare_processes(data: Path, count: int) -> Iterator[Callable[[], None]]:
    """Yield a function that makes each of ``count`` running processes step through the whole dataset."""
    started = [
        subprocess.Popen(
            [sys.executable, "-c", _BARE_SCRIPT, str(data)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(count)
    ]

    def wait_for(word: str) -> None:
        for process in started:
            assert process.stdout is not None
            assert process.stdout.readline() == f"{word}\n"

    def run() -> None:
        for process in started:
            assert process.stdin is not None
            process.stdin.write("\n")
            process.stdin.flush()
        wait_for("done")

    try:
        wait_for("ready")
        yield run
    finally:
        for process in started:
            process.communicate()


def verification_row(rounds: int, episodes: int, cores: int) -> Row:
    """Measure the complete check of a dataset on all cores against bare stepping on all cores."""
    published = publish_recipe(Recipe(Variant.parse("halfcheetah-base"), episodes=episodes), force=True)

    def check(jobs: int) -> None:
        assert verify(published.dataset_id, jobs=jobs) == []

    assert published.path is not None
    data = published.path / "data"
    with _start_bare_processes(data, 1) as bare, _start_bare_processes(data, cores) as bare_everywhere:
        seconds = take_turns(
            {
                "one core": lambda: check(1),
                "all cores": lambda: check(cores),
                "bare, one core": bare,
                "bare, all cores": bare_everywhere,
            },
            rounds,
            processes=True,
        )
    # Each process steps through the whole dataset.
    seconds["bare, all cores"] = [value / cores for value in seconds["bare, all cores"]]
    return Row(
        f"verify {episodes} episodes of halfcheetah, including the replay",
        rates(seconds, published.steps),
        "steps/s",
        {
            "of bare stepping, all cores": ratio(seconds["bare, all cores"], seconds["all cores"]),
            "of bare stepping, one core": ratio(seconds["bare, one core"], seconds["one core"]),
            "bare stepping, all cores to one": ratio(seconds["bare, one core"], seconds["bare, all cores"]),
        },
        {"of bare stepping, all cores": ("least", 0.8)},
        f"bare stepping on all cores is measured in {cores} processes at once",
    )


def publishing_row(episodes: int, scaling: float, collections: dict[str, Row]) -> Row:
    """Extrapolate publishing the whole catalogue, 154 x 100 episodes, from some variants of each robot.

    Args:
        episodes: number of episodes per dataset in the sample.
        scaling: the speed of two processes relative to one.
        collections: maps each robot to its row of collecting.
    """
    ours = stock = 0.0
    rates = []
    for robot in ROBOTS:
        rate = _measure_publishing_rate(robot, episodes)
        total = len(catalogue(robot)) * 100 * 1000
        ours += total / rate / scaling
        stock += total / collections[robot].figures[STOCK]
        rates.append(f"{robot} {rate:,.0f} steps/s")
    few, many = (_measure_publishing_memory(variants) for variants in (4, 16))
    return Row(
        "publish all 154 x 100 episodes of 1000 steps, two cores",
        {OURS: ours / 60, "stock, one process": stock / 60},
        "min",
        {"minutes": ours / 60, "peak memory, 16 variants to 4": many / few},
        {"minutes": ("most", 25.0), "peak memory, 16 variants to 4": ("most", 1.05)},
        f"extrapolated from {episodes} episodes of 4 variants per robot, digests and checks included: "
        f"{', '.join(rates)}; peak {many / 2**20:.0f} MB per process",
    )


def _measure_publishing_rate(robot: str, episodes: int) -> float:
    """Return the rate, in steps per second and process, of publishing some variants of a robot."""
    everything = catalogue(robot)
    chosen = everything[:: len(everything) // 4][:4]
    recipes = [Recipe(variant, episodes=episodes) for variant in chosen]
    outcomes = [publish_recipe(recipe, force=True) for recipe in recipes]
    return sum(outcome.steps for outcome in outcomes) / sum(outcome.seconds for outcome in outcomes)


_PUBLISH_SCRIPT = """
import sys
from scripts.speed.measuring import peak_memory
from imujoco_minari.publishing.publisher import publish_all
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.variants import catalogue
recipes = [Recipe(variant, "random", 20) for variant in catalogue("halfcheetah")[:int(sys.argv[1])]]
assert not any(outcome.error for outcome in publish_all(recipes, force=True))
print(peak_memory())
"""


def _measure_publishing_memory(variants: int) -> int:
    """Return the peak memory in bytes of a process that publishes ``variants`` variants."""
    done = subprocess.run(
        [sys.executable, "-c", _PUBLISH_SCRIPT, str(variants)], capture_output=True, text=True, check=True
    )
    return int(done.stdout)


def cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0))
