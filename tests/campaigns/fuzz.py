"""The fuzzing campaign: coverage-guided input to all that reads what comes from outside.

Run by scripts/test-fuzz, once for each target. Whatever the input, only an ImujocoError may come out.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["imujoco_minari"]):
    from imujoco_minari.envs.external_mjcf import check_text
    from imujoco_minari.errors import ImujocoError
    from imujoco_minari.importing.safe_unpack import open_zip, read_npz
    from imujoco_minari.policies import read_actor
    from imujoco_minari.policies.torch_file import TorchFile
    from imujoco_minari.storage import minari_root
    from imujoco_minari.storage.metadata import read_metadata
    from imujoco_minari.variants import Variant, parse_dataset_id, parse_specification
    from imujoco_minari.variants.original import OriginalVariant
    from imujoco_minari.verification.identity import loadable

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


def torch_pickle(data: bytes) -> None:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a/data.pkl", data)
        archive.writestr("a/data/0", bytes(64))
    opened = TorchFile(file)
    for name in opened.tensors:
        opened.read(name)


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
    if name in ("torch_pickle", "policy", "safetensors"):
        import torch
        from safetensors.torch import save

        shapes = {"latent_pi.0": (2, 11), "mu": (3, 2), "log_std": (3, 2)}
        state = {f"{layer}.weight": torch.zeros(shape) for layer, shape in shapes.items()}
        state |= {f"{layer}.bias": torch.zeros(shape[0]) for layer, shape in shapes.items()}
        if name == "safetensors":
            return [save(state)]
        pth, outer = io.BytesIO(), io.BytesIO()
        torch.save({f"actor.{key}": value for key, value in state.items()}, pth)
        if name == "torch_pickle":
            with zipfile.ZipFile(pth) as inner:
                entry = next(entry for entry in inner.namelist() if entry.endswith("data.pkl"))
                return [inner.read(entry)]
        with zipfile.ZipFile(outer, "w") as zipped:
            zipped.writestr("data", "{}")
            zipped.writestr("policy.pth", pth.getvalue())
        return [outer.getvalue()]
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

    options = ["-timeout=20", "-rss_limit_mb=3000", "-max_len=20000", "-print_final_stats=1"]
    atheris.Setup([sys.argv[0], str(corpus), *options, *sys.argv[1:]], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
