"""The fuzzing campaign: coverage-guided input to all that reads what comes from outside.

Run by scripts/test-fuzz, once for each target. Whatever the input, only an ImujocoError may come out.
"""

from __future__ import annotations

import contextlib
import io
import json
import resource
import sys
import tempfile
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import atheris
import torch
from safetensors.numpy import save as safetensors_bytes

sys.path.insert(0, str(Path(__file__).parents[1]))

with atheris.instrument_imports(include=["imujoco_minari"]):
    from imujoco_minari.envs.untrusted_mjcf import check_text
    from imujoco_minari.errors import ImujocoError, JobError
    from imujoco_minari.importing.safe_unpack import open_zip, read_npz
    from imujoco_minari.policies import files, read_actor, sb3_reader
    from imujoco_minari.storage import minari_root
    from imujoco_minari.storage.metadata import read_metadata
    from imujoco_minari.variants import Variant, parse_dataset_id, parse_specification
    from imujoco_minari.variants.original import OriginalVariant
    from imujoco_minari.verification.identity import loadable

from policy_zips import saved, write_zip
from random_actors import random_actor

FOLDER = Path(tempfile.mkdtemp())


def written(name: str, data: bytes) -> Path:
    path = FOLDER / name
    path.write_bytes(data)
    return path


def ids(data: bytes) -> None:
    text = data.decode("utf-8", "surrogateescape")
    for parse in (Variant.parse, OriginalVariant.parse, parse_dataset_id, minari_root.dataset_folder):
        with contextlib.suppress(ImujocoError):
            parse(text)


def dataset_ids(data: bytes) -> None:
    folder = minari_root.dataset_folder(data.decode("utf-8", "surrogateescape"))
    relative = folder.relative_to(minari_root.datasets_root())
    assert not any(part in ("..", ".", "data") or part.startswith(".") for part in relative.parts)


def catalogue(data: bytes) -> None:
    parse_specification(data.decode("utf-8", "replace"), "fuzz.toml")


def in_process(function: str, argument: str, **limits: int) -> bytes:
    """Read a zip in this process, whose memory main() limits, instead of in a child process."""
    try:
        return sb3_reader.read_zip(argument)
    except MemoryError:
        raise JobError("needs too much memory") from None


files.run_limited = in_process


def torch_pickle(data: bytes) -> None:
    """Read a good policy whose pickle is replaced."""
    pth, entries = io.BytesIO(), good_policy()
    with zipfile.ZipFile(pth, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, data if name.endswith("data.pkl") else content)
    read_actor(write_zip(FOLDER / "fuzz.zip", pth.getvalue()))


@cache
def good_policy() -> dict[str, bytes]:
    """Return the entries of the ``policy.pth`` of a small actor."""
    weights = random_actor(widths=(2,)).weights.items()
    pth = saved({f"actor.{name}": torch.from_numpy(array) for name, array in weights})
    with zipfile.ZipFile(io.BytesIO(pth)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def policy(data: bytes) -> None:
    read_actor(written("fuzz.zip", data))


def safetensors(data: bytes) -> None:
    read_actor(written("fuzz.safetensors", data))


def npz(data: bytes) -> None:
    read_npz(written("fuzz.npz", data))


def npy(data: bytes) -> None:
    path = FOLDER / "fuzz.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data.npy", data)
    read_npz(path)


def archive(data: bytes) -> None:
    with open_zip(written("fuzz-archive.zip", data)) as opened:
        for name in opened.namelist():
            opened.read(name)


def metadata(data: bytes) -> None:
    written("metadata.json", data)
    list(loadable(read_metadata(FOLDER)))


def env_spec(data: bytes) -> None:
    text = data.decode("utf-8", "replace")
    list(loadable(dict.fromkeys(("env_spec", "eval_env_spec", "observation_space", "action_space"), text)))


def mjcf(data: bytes) -> None:
    check_text(data.decode("utf-8", "replace"), "fuzz")


TARGETS: dict[str, tuple[Callable[[bytes], None], list[bytes]]] = {
    "ids": (ids, [b"hopper-massdec_25_leggeom", b"imujoco/walker2d-base-random-v0"]),
    "dataset_ids": (dataset_ids, [b"imujoco/hopper-all-v0", b"a/b/../c-v0", b"data/x-v1"]),
    "catalogue": (
        catalogue,
        [b'environment = "Hopper-v5"\nmodel = "x"\nfeet = ["a"]\n[mass]\npercents = [1]\nbodies = ["a"]\n'],
    ),
    "torch_pickle": (torch_pickle, []),
    "policy": (policy, []),
    "safetensors": (safetensors, []),
    "npz": (npz, []),
    "npy": (npy, []),
    "archive": (archive, []),
    "metadata": (metadata, [json.dumps({"data_format": "hdf5", "env_spec": "{}"}).encode()]),
    "env_spec": (
        env_spec,
        [
            json.dumps(spec).encode()
            for spec in (
                {"entry_point": "imujoco_minari.envs:X", "kwargs": {}, "additional_wrappers": []},
                {"type": "Box", "dtype": "float32", "shape": [1], "low": [-1.0], "high": [1.0]},
            )
        ],
    ),
    "mjcf": (mjcf, [b"<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"]),
}


def seeds(name: str) -> list[bytes]:
    """Return inputs to start from; those that are files of other libraries are made here."""
    given = TARGETS[name][1]
    if name in ("npz", "npy", "archive"):
        import numpy as np

        plain, packed, single = io.BytesIO(), io.BytesIO(), io.BytesIO()
        np.savez(plain, data=np.zeros((2, 3)))
        np.savez_compressed(packed, data=np.zeros((2, 3), np.float32))
        np.save(single, np.zeros((2, 3)))
        return [single.getvalue()] if name == "npy" else [plain.getvalue(), packed.getvalue()]
    if name == "torch_pickle":
        return [content for entry, content in good_policy().items() if entry.endswith("data.pkl")]
    if name == "policy":
        weights = random_actor(widths=(2,)).weights.items()
        state = {f"actor.{key}": torch.from_numpy(array) for key, array in weights}
        return [write_zip(FOLDER / "seed.zip", saved(state)).read_bytes()]
    if name == "safetensors":
        return [safetensors_bytes(dict(random_actor(widths=(2,)).weights))]
    return given


def main() -> None:
    name = sys.argv.pop(1)
    target, _ = TARGETS[name]
    corpus = FOLDER / "corpus"
    corpus.mkdir()
    for number, seed in enumerate(seeds(name)):
        (corpus / str(number)).write_bytes(seed)

    def one(data: bytes) -> None:
        with contextlib.suppress(ImujocoError):
            target(data)

    # An input that asks for more memory gets a MemoryError, as in the child process of read_actor().
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + files.MAX_MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    options = ["-timeout=20", "-rss_limit_mb=3000", "-max_len=20000", "-print_final_stats=1"]
    atheris.Setup([sys.argv[0], str(corpus), *options, *sys.argv[1:]], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
