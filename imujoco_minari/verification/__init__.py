"""Is a dataset what it says it is? Structure, attributes, digests, and a replay of every episode.

The replay resets the variant's environment with each recorded seed, applies the recorded actions and
compares every observation, reward and flag, bit for bit. It is exact only under the MuJoCo version
and on the processor architecture that made the dataset; another version is itself a finding.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np

from imujoco_minari import content, roots
from imujoco_minari.errors import DatasetNotFoundError, ImujocoError
from imujoco_minari.importing.original import CATALOGUE, OriginalVariant, is_original, variant_of
from imujoco_minari.mjcf import canonical_mjcf, mjcf_sha256
from imujoco_minari.registration import make

MAX_FINDINGS = 100
# One HDF5 attribute or array that claims more than this is refused before it is read.
MAX_ARRAY_BYTES = 2**31


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong: where (an HDF5 path or a metadata key) and what."""

    where: str
    what: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}"


def verify(
    dataset_id: str, *, replay: bool = True, on_episode: Callable[[], None] | None = None
) -> list[Finding]:
    """Check a dataset of the Minari root and return what is wrong with it; an empty list is good news.

    Args:
        dataset_id: a dataset that this package published, or a collection of such.
        replay: replay every episode, beside the checks of structure, attributes and digests.
        on_episode: called after each episode that was replayed.

    Raises:
        DatasetNotFoundError: when the root holds no such dataset.
    """
    folder = roots.dataset_folder(dataset_id)
    if not folder.exists():
        raise DatasetNotFoundError(
            f"{dataset_id} is not in the Minari root, at {folder}; see `minari list local`"
        )
    findings = inspect(folder / "data", replay_episodes=None if replay else 0, on_episode=on_episode)
    stated = _read_metadata(folder / "data").get("dataset_id")
    if stated != dataset_id:
        findings.insert(
            0,
            Finding("metadata.json/dataset_id", f"is {stated!r}, but the dataset lies under {dataset_id!r}"),
        )
    return findings


def inspect(
    data: Path, *, replay_episodes: int | None = None, on_episode: Callable[[], None] | None = None
) -> list[Finding]:
    """Check the Minari storage in the folder ``data`` and return what is wrong with it.

    Args:
        data: the folder with ``main_data.hdf5`` and ``metadata.json``.
        replay_episodes: how many episodes to replay; None for all.
        on_episode: called after each episode that was replayed.
    """
    findings: list[Finding] = []
    checks = _checks(data, replay_episodes, on_episode)
    try:
        for finding in checks:
            findings.append(finding)
            if len(findings) >= MAX_FINDINGS:
                findings.append(Finding(str(data), f"stopped after {MAX_FINDINGS} findings"))
                break
    except Exception as error:  # h5py raises anything at all on a damaged file; none of it is ours
        findings.append(Finding(str(data), f"cannot be read: {type(error).__name__}: {str(error)[:200]}"))
    return findings


def _checks(
    data: Path, replay_episodes: int | None, on_episode: Callable[[], None] | None
) -> Iterator[Finding]:
    for name in ("metadata.json", content.MAIN_FILE):
        if not (data / name).is_file():
            yield Finding(name, "is missing")
            return
    metadata = _read_metadata(data)
    if not metadata:
        yield Finding("metadata.json", "is no JSON object")
        return
    with h5py.File(content.main_file(data), "r") as file:
        names = set(file)
        expected = {f"episode_{i}" for i in range(len(names))}
        if names != expected:
            yield Finding(content.MAIN_FILE, f"holds {sorted(names ^ expected)[0]!r} out of sequence")
            return
        structure = list(_structure(file, metadata))
        yield from structure
        if structure:
            return
        yield from _attributes(file, metadata)
        yield from _digests(file, metadata)
        count = len(file) if replay_episodes is None else min(replay_episodes, len(file))
        yield from _replay(file, range(count), on_episode)


def _read_metadata(data: Path) -> dict[str, Any]:
    try:
        metadata = json.loads((data / "metadata.json").read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return metadata if isinstance(metadata, dict) else {}


def _structure(file: h5py.File, metadata: dict[str, Any]) -> Iterator[Finding]:
    """Check that every episode has its arrays, of the right shapes, and that the totals add up."""
    if not len(file):
        yield Finding(content.MAIN_FILE, "holds no episode")
    steps = 0
    for number in range(len(file)):
        name = f"episode_{number}"
        group = file[name]
        if not isinstance(group, h5py.Group):
            yield Finding(name, "is no group")
            continue
        missing = [key for key in content.ARRAYS if not isinstance(group.get(key), h5py.Dataset)]
        if missing:
            yield Finding(name, f"has no {missing[0]}")
            continue
        large = [key for key, array in content.arrays(group) if array.nbytes > MAX_ARRAY_BYTES]
        if large:
            yield Finding(f"{name}/{large[0]}", f"claims more than {MAX_ARRAY_BYTES} bytes")
            continue
        length = len(group["rewards"])
        steps += length
        # A linked episode is its source's, number and all.
        linked = isinstance(file.get(name, getlink=True), h5py.ExternalLink)
        yield from _episode_structure(
            group, name, int(group.attrs.get("id", -1)) if linked else number, length
        )
    for key, value in (("total_episodes", len(file)), ("total_steps", steps)):
        if metadata.get(key) != value:
            yield Finding(f"metadata.json/{key}", f"is {metadata.get(key)!r}, but the file holds {value}")


def _episode_structure(group: h5py.Group, name: str, number: int, length: int) -> Iterator[Finding]:
    attrs = group.attrs
    for key, value in (("id", number), ("total_steps", length)):
        if key not in attrs or attrs[key] != value:
            yield Finding(f"{name}@{key}", f"is {attrs.get(key)!r}, not {value}")
    if "seed" not in attrs and attrs.get(content.REPLAYABLE, True):
        yield Finding(f"{name}@seed", "is missing, so the episode cannot be replayed")
    for key in content.ARRAYS:
        expected = length + 1 if key == "observations" else length
        if len(group[key]) != expected:
            yield Finding(f"{name}/{key}", f"has {len(group[key])} rows, not {expected}")
            return
    if not length:
        yield Finding(name, "has no steps")
        return
    terminations, truncations = group["terminations"][()], group["truncations"][()]
    if (terminations[:-1] | truncations[:-1]).any():
        yield Finding(name, "goes on after a termination or truncation")
    if not terminations[-1] and not truncations[-1]:
        yield Finding(name, "ends without a termination or truncation")
    for key in ("observations", "actions", "rewards"):
        if not np.isfinite(group[key][()]).all():
            yield Finding(f"{name}/{key}", "holds values that are not finite")
    rewards_sum = float(group["rewards"][()].sum())
    if "rewards_sum" not in attrs or not np.isclose(attrs["rewards_sum"], rewards_sum, rtol=1e-9):
        yield Finding(
            f"{name}@rewards_sum", f"is {attrs.get('rewards_sum')!r}, but the rewards sum to {rewards_sum}"
        )


def _attributes(file: h5py.File, metadata: dict[str, Any]) -> Iterator[Finding]:
    """Check that root, metadata and episodes say the same of the variant, and that it is true."""
    collection = "combined_datasets" in metadata
    for number in range(len(file)):
        attrs = file[f"episode_{number}"].attrs
        name = f"episode_{number}"
        try:
            variant = variant_of(attrs)
        except (ImujocoError, KeyError):
            yield Finding(f"{name}@variant", f"is {attrs.get('variant')!r}, which is no variant")
            continue
        for key, value in content.attributes(variant, str(attrs.get("tier"))).items():
            if key not in attrs or attrs[key] != value:
                yield Finding(f"{name}@{key}", f"is {attrs.get(key)!r}, not {value!r}")
        if not collection:
            for key in ("variant", "tier", CATALOGUE, content.REPLAYABLE):
                if attrs.get(key) != file.attrs.get(key):
                    yield Finding(
                        f"{name}@{key}",
                        f"is {attrs.get(key)!r}, but the dataset's is {file.attrs.get(key)!r}",
                    )
    if collection:
        return
    variant = variant_of(file.attrs)
    for key in (*content.attributes(variant, ""), "mjcf_sha256", CATALOGUE, content.REPLAYABLE):
        if metadata.get(key) != file.attrs.get(key):
            yield Finding(
                f"metadata.json/{key}", f"is {metadata.get(key)!r}, but the file's is {file.attrs.get(key)!r}"
            )
    text = str(file.attrs["mjcf"])
    if mjcf_sha256(text) != file.attrs["mjcf_sha256"]:
        yield Finding("@mjcf", "does not have the digest that mjcf_sha256 states")
    elif isinstance(variant, OriginalVariant):
        if json.loads(metadata["env_spec"])["kwargs"].get("mjcf") != text:
            yield Finding("metadata.json/env_spec", "runs another model than @mjcf")
    elif text != canonical_mjcf(variant):
        yield Finding("@mjcf", f"is not the model that {_simulator()} makes of the variant")


def _digests(file: h5py.File, metadata: dict[str, Any]) -> Iterator[Finding]:
    """Check every array against its digest, and the digests against the dataset's."""
    intact = True
    for number in range(len(file)):
        for key, array in content.arrays(file[f"episode_{number}"]):
            stated = array.attrs.get(content.DIGEST)
            if stated != content.array_sha256(array[()]):
                intact = False
                yield Finding(
                    f"episode_{number}/{key}",
                    "does not have the digest stored with it" if stated else "has no digest",
                )
    if not intact or ("content_sha256" not in {**file.attrs, **metadata} and _links(file)):
        return
    digest = content.content_sha256(file, len(file))
    for where, stated in (
        ("@content_sha256", file.attrs.get("content_sha256")),
        ("metadata.json/content_sha256", metadata.get("content_sha256")),
    ):
        if stated != digest:
            yield Finding(where, f"is {stated!r}, but the content's is {digest}")


def _links(file: h5py.File) -> bool:
    """Return whether the file is a linked collection, which keeps no digest of what lies elsewhere."""
    return all(isinstance(file.get(name, getlink=True), h5py.ExternalLink) for name in file)


def _replay(file: h5py.File, episodes: range, on_episode: Callable[[], None] | None) -> Iterator[Finding]:
    """Replay episodes from their seeds and actions and compare, bit for bit."""
    environments: dict[str, gym.Env[Any, Any]] = {}
    try:
        for number in episodes:
            group = file[f"episode_{number}"]
            name = str(group.attrs["variant"])
            if _can_replay(file, group):
                if name not in environments:
                    environments[name] = _environment(file, group)
                yield from _replay_episode(group, f"episode_{number}", environments[name])
            if on_episode is not None:
                on_episode()
    finally:
        for env in environments.values():
            env.close()


def _can_replay(file: h5py.File, group: h5py.Group) -> bool:
    # An original's model stands in its dataset; a collection of several holds none.
    return bool(group.attrs.get(content.REPLAYABLE, True)) and (
        not is_original(group.attrs) or "mjcf" in file.attrs
    )


def _environment(file: h5py.File, group: h5py.Group) -> gym.Env[Any, Any]:
    variant = variant_of(group.attrs)
    if isinstance(variant, OriginalVariant):
        return gym.make(variant.environment_spec(str(file.attrs["mjcf"])))
    return make(variant)


def _replay_episode(group: h5py.Group, name: str, env: gym.Env[Any, Any]) -> Iterator[Finding]:
    recorded = {key: group[key][()] for key in content.ARRAYS}
    actions, length = recorded["actions"], len(recorded["rewards"])
    replayed = {key: np.empty_like(recorded[key]) for key in content.ARRAYS if key != "actions"}
    replayed["observations"][0], _ = env.reset(seed=int(group.attrs["seed"]))
    steps = length
    for step in range(length):
        observation, reward, terminated, truncated, _ = env.step(actions[step])
        replayed["observations"][step + 1] = observation
        replayed["rewards"][step] = reward
        replayed["terminations"][step], replayed["truncations"][step] = terminated, truncated
        if terminated or truncated:
            steps = step + 1
            break
    if steps < length:
        yield Finding(name, f"has {length} steps, but its replay ends after {steps}")
    for key, values in replayed.items():
        rows = steps + 1 if key == "observations" else steps
        # Compared as bytes, so that -0.0 is not 0.0.
        ours = values[:rows].reshape(rows, -1).view(np.uint8)
        theirs = recorded[key][:rows].reshape(rows, -1).view(np.uint8)
        differing = np.flatnonzero((ours != theirs).any(axis=1))
        if len(differing):
            yield Finding(
                f"{name}/{key}[{differing[0]}]",
                f"differs from its replay by {_simulator()}, as do {len(differing) - 1} later rows",
            )


def _simulator() -> str:
    return f"mujoco {version('mujoco')} and gymnasium {version('gymnasium')}"
