"""The policies and datasets that the benchmarks use, in a temporary Minari root."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from safetensors.numpy import save_file

from imujoco_minari.errors import PolicyNotFoundError
from imujoco_minari.policies import Actor, expert_actor, expert_record, read_actor
from imujoco_minari.publishing.publisher import publish_recipe
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.storage import minari_root
from imujoco_minari.variants import Variant, bases, catalogue, specification

UNTRAINED = "untrained policy, so short episodes"


def actor_of(robot: str, folder: Path | None) -> tuple[Actor, str]:
    """Return an actor for a robot's base, and a description of its origin.

    It is the first of these that exists: ``<robot>.safetensors`` in ``folder``, the shipped expert, or an
    actor with random weights.
    """
    if folder is not None and (folder / f"{robot}.safetensors").is_file():
        return read_actor(folder / f"{robot}.safetensors"), "given policy"
    try:
        return expert_actor(Variant.parse(f"{robot}-base")), "expert"
    except (PolicyNotFoundError, KeyError):
        return _make_untrained(*specification(robot).sizes), UNTRAINED


def _make_untrained(observations: int, actions: int) -> Actor:
    rng = np.random.default_rng(0)
    shapes = {
        "latent_pi.0": (256, observations),
        "latent_pi.2": (256, 256),
        "mu": (actions, 256),
        "log_std": (actions, 256),
    }
    weights = {}
    for name, shape in shapes.items():
        weights[f"{name}.weight"] = rng.normal(0, shape[1] ** -0.5, shape).astype(np.float32)
        weights[f"{name}.bias"] = np.zeros(shape[0], np.float32)
    return Actor(weights)


def stand_in_records(folder: Path) -> None:
    """Write a record for each variant that has none, so that no row measures random rollouts.

    A record states the returns of the random policy. Without a record, publishing rolls out 100 random
    episodes.
    """
    folder.mkdir(parents=True, exist_ok=True)
    random = {"return_mean": 0.0, "episodes": 100}
    for variant in (*catalogue(), *bases()):
        if not expert_record(variant):
            (folder / f"{variant}.json").write_text(json.dumps({"random": random}))


@contextmanager
def saved_actor(robot: str, folder: Path | None) -> Iterator[tuple[Path, str]]:
    """Yield a file with the actor of :func:`actor_of`, for recipes, and the description of its origin."""
    actor, origin = actor_of(robot, folder)
    with TemporaryDirectory() as place:
        path = Path(place) / "actor.safetensors"
        save_file({name: np.ascontiguousarray(array) for name, array in actor.weights.items()}, path)
        yield path, origin


def publish_copies(variant: Variant, policy: Path, episodes: int, copies: int) -> list[str]:
    """Publish a dataset and copies of it with other ids. Stock Minari combines only equal environments."""
    first = publish_recipe(Recipe(variant, "bench", episodes, policy=policy)).dataset_id
    ids = []
    for number in range(copies):
        dataset_id = f"bench/{variant.robot}-{number}-v0"
        folder = minari_root.dataset_folder(dataset_id)
        if not folder.exists():
            shutil.copytree(minari_root.dataset_folder(first), folder)
            path = folder / "data" / "metadata.json"
            path.write_text(json.dumps(json.loads(path.read_text("utf-8")) | {"dataset_id": dataset_id}))
        ids.append(dataset_id)
    return ids
