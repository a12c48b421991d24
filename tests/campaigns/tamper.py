"""The tampering campaign: one meaning of a sound dataset changes, all digests are made right again.

Run by scripts/test-fuzz. Each trial changes one value of the metadata, of an attribute or of an array, or
moves, copies or removes episodes. `inspect` must report a finding, or an exception that the sound dataset
does not have. What no check can find is in docs/promises.md and in `UNKNOWABLE`.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from ending import finish

from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.storage import file_format
from imujoco_minari.storage.metadata import complete_metadata, read_metadata
from imujoco_minari.variants import Ranges
from imujoco_minari.verification import inspect

# The campaign makes digests and the size right again. No check can know the rest: see docs/promises.md.
# Minari uses jpeg_encoding for images only, and NumPy is one of the versions.
RESEALED = {"file_sha256", "metadata_sha256", "content_sha256", "dataset_size", "sha256"}
UNKNOWABLE = {"description", "author", "machine", "simd", "jpeg_encoding", "versions"}
# Of a collection also the sources and policies that it should have, and its own name.
UNKNOWABLE_OF_COLLECTIONS = UNKNOWABLE | {
    "combined_datasets",
    "algorithm_name",
    "requirements",
    "dataset_id",
    "source",
}
WORDS = (
    "",
    "hopper-base",
    "hopper-massdec_25_leggeom",
    "walker2d-base",
    "random",
    "expert",
    "imujoco/hopper-base-v0",
    "imujoco/hopper-massdec_25_leggeom-random-v0",
    "0" * 64,
    "0.0.1",
    "imujoco-original",
    "\x1b[2J",
)


class Dataset:
    """A copy of a sound dataset that a trial changes.

    Attributes:
        file: its open HDF5 file.
        metadata: its metadata, which :meth:`seal` writes.
    """

    def __init__(self, data: Path, file: h5py.File) -> None:
        self.data, self.file, self.metadata = data, file, read_metadata(data)

    @property
    def episodes(self) -> list[h5py.Group]:
        return [self.file[file_format.episode_name(number)] for number in range(len(self.file))]

    def arrange(self, numbers: list[int]) -> None:
        """Let the file hold copies of the numbered episodes, in this order."""
        for place, number in enumerate(numbers):
            self.file.copy(file_format.episode_name(number), f"new_{place}")
        for name in [name for name in self.file if name.startswith("episode_")]:
            del self.file[name]
        for place in range(len(numbers)):
            self.file.move(f"new_{place}", file_format.episode_name(place))
            self.file[file_format.episode_name(place)].attrs["id"] = place
        steps = sum(int(episode.attrs["total_steps"]) for episode in self.episodes)
        self.metadata |= {"total_episodes": len(numbers), "total_steps": steps}

    def seal(self) -> None:
        """Make the digests of arrays, episodes and content right again, and write the metadata."""
        for episode in self.episodes:
            file_format.seal_episode(episode)
        digest = file_format.content_sha256(self.file, len(self.file))
        self.file.attrs["content_sha256"] = digest
        self.metadata["content_sha256"] = digest
        (self.data / "metadata.json").write_text(json.dumps(self.metadata))


def other(value: Any, rng: random.Random) -> Any:
    """Return another JSON value of the same kind, or sometimes of another."""
    if rng.random() < 0.15:
        return rng.choice([None, 5, True, "x", [], {}, 1e300, -1])
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + rng.choice([-1, 1, 100, 2**31])
    if isinstance(value, float):
        return value * rng.choice([0.0, -1.0, 1.0001, 10.0]) + rng.choice([0.0, 1e-3, 1.0])
    if isinstance(value, str):
        try:
            inner = json.loads(value)
        except ValueError:
            inner = None
        if isinstance(inner, dict):
            return json.dumps(changed(inner, rng))
        return rng.choice([*WORDS, value + "x", value[:-1], value.upper()])
    if isinstance(value, list):
        return rng.choice([value + ["x"], value[1:], value[::-1], [other(each, rng) for each in value]])
    return changed(value, rng) if isinstance(value, dict) else rng.choice([1, "x", [value]])


def changed(values: dict[str, Any], rng: random.Random, keys: list[str] | None = None) -> dict[str, Any]:
    """Return a dict of which one value is another, missing or new."""
    if not values:
        return {"x": 1}
    key = rng.choice(sorted(keys or values))
    if rng.random() < 0.2:
        return {name: value for name, value in values.items() if name != key}
    return values | {key: other(values[key], rng)}


def change_metadata(dataset: Dataset, rng: random.Random) -> str:
    keys = sorted(dataset.metadata.keys() - RESEALED)
    before = dataset.metadata
    dataset.metadata = changed(before, rng, keys)
    every = before.keys() | dataset.metadata.keys()
    differing = [key for key in every if meaning(before.get(key)) != meaning(dataset.metadata.get(key))]
    return differing[0] if differing else ""


def meaning(value: Any) -> Any:
    """Return a value of the metadata. In a JSON text, a missing entry means the same as null."""
    try:
        inner = json.loads(value)
    except (TypeError, ValueError):
        return value
    if not isinstance(inner, dict):
        return value
    return {key: entry for key, entry in inner.items() if entry is not None}


def change_attribute(dataset: Dataset, rng: random.Random) -> str:
    owner = rng.choice([dataset.file, *dataset.episodes])
    key = rng.choice(sorted(owner.attrs.keys() - RESEALED))
    value = owner.attrs[key]
    value = value.item() if isinstance(value, np.generic) else value
    new = other(value, rng)
    if new is None or isinstance(new, dict) or (isinstance(new, list) and not new) or rng.random() < 0.1:
        if key == "source":
            # An episode that states no source is of its own dataset.
            return ""
        del owner.attrs[key]
    elif new == value and type(new) is type(value):
        return ""
    else:
        owner.attrs[key] = new
    return str(key)


def change_value(dataset: Dataset, rng: random.Random) -> str:
    episode, key = rng.choice(dataset.episodes), rng.choice(file_format.ARRAYS)
    values = episode[key][()]
    place = tuple(rng.randrange(size) for size in values.shape)
    if values.dtype == bool:
        values[place] = not values[place]
    else:
        values[place] = rng.choice(
            [np.nextafter(values[place], values.dtype.type(9)), -values[place] - 1, 0.5, np.nan]
        )
    if np.array_equal(values, episode[key][()]):
        return ""
    episode[key][...] = values
    return f"array {key}"


def change_type(dataset: Dataset, rng: random.Random) -> str:
    key = rng.choice(file_format.ARRAYS)
    dtype = rng.choice(["f2", "f4", "f8", ">f8", "i8", "u1"])
    for episode in rng.choice([dataset.episodes, dataset.episodes[:1]]):
        values = episode[key][()]
        if values.dtype == np.dtype(dtype):
            return ""
        del episode[key]
        episode[key] = values.astype(dtype)
    return f"type {key}"


def change_arrays(dataset: Dataset, rng: random.Random) -> str:
    """Swap one array of two episodes, add an array or a group, or cut an episode."""
    first, second = rng.sample(dataset.episodes, 2)
    key = rng.choice(file_format.ARRAYS)
    kind = rng.choice(["swap", "extra", "group", "cut"])
    if kind == "swap":
        values = [first[key][()], second[key][()]]
        if np.array_equal(*values):
            return ""
        for episode, new in ((first, values[1]), (second, values[0])):
            del episode[key]
            episode[key] = new
    elif kind == "extra":
        first["infos/x" if rng.random() < 0.5 else "x"] = [1.0]
    elif kind == "group":
        first["infos"].create_group("x")
    else:
        for name in file_format.ARRAYS:
            values = first[name][:-2]
            del first[name]
            first[name] = values
        first.attrs["total_steps"] -= 2
        dataset.metadata["total_steps"] -= 2
    return f"arrays {kind}"


def change_order(dataset: Dataset, rng: random.Random) -> str:
    count = len(dataset.episodes)
    numbers = [rng.randrange(count) for _ in range(rng.randrange(1, count + 2))]
    if numbers == list(range(len(numbers))):
        # Without its last episodes, a dataset is a sound one of fewer episodes.
        return ""
    dataset.arrange(numbers)
    return "order"


CHANGES: tuple[Callable[[Dataset, random.Random], str], ...] = (
    change_metadata,
    change_metadata,
    change_attribute,
    change_attribute,
    change_value,
    change_type,
    change_arrays,
    change_order,
)


def knowable(dataset_id: str, what: str) -> bool:
    """Return whether a check could find a change of one meaning of a dataset."""
    if "both" in dataset_id:
        return what not in UNKNOWABLE_OF_COLLECTIONS and what != "order"
    return what not in UNKNOWABLE


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    ends: Counter[str] = Counter()
    failures: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["MINARI_DATASETS_PATH"] = folder
        ids = [publish(name, tier="random", episodes=3).dataset_id for name in ("hopper-base", WORDS[2])]
        ids.append(publish("hopper-base", tier="ranked", episodes=5).dataset_id)
        ids.append(
            publish(Ranges("hopper", {"mass/torsogeom": (-50, 100)}), tier="random", episodes=3).dataset_id
        )
        ids.append(combine_datasets(ids[:2], "imujoco/hopper-both-v0").id)
        sound = {dataset_id: inspect(Path(folder) / dataset_id / "data") for dataset_id in ids}
        assert not any(sound.values()), sound
        start = time.monotonic()
        while time.monotonic() - start < options.seconds:
            dataset_id, change = rng.choice(ids), rng.choice(CHANGES)
            data = Path(folder) / "copy" / "data"
            shutil.rmtree(data.parent, ignore_errors=True)
            shutil.copytree(Path(folder) / dataset_id, data.parent)
            with h5py.File(file_format.main_file(data), "a") as file:
                dataset = Dataset(data, file)
                what = change(dataset, rng)
                if not what:
                    continue
                dataset.seal()
            complete_metadata(data, {})
            try:
                found = inspect(data)
            except Exception:
                failures.append(f"{dataset_id}: {what}: {traceback.format_exc()}")
                continue
            said = found or found.exceptions != sound[dataset_id].exceptions
            end = "finding" if found else "exception" if said else "nothing"
            ends[f"{change.__name__.removeprefix('change_')}: {end}"] += 1
            if not said and knowable(dataset_id, what):
                failures.append(f"{dataset_id}: {what}: {dataset.metadata.get(what)!r}")
    finish(f"{sum(ends.values())} changed meanings, {len(failures)} not found", ends, failures)


if __name__ == "__main__":
    main()
