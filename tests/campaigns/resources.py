"""The resource campaign: small inputs that claim huge sizes, read under a limit on memory and time.

Run by scripts/test-fuzz. A forked process reads each input with little address space. An error of this
package, or a finding, must come of it: no MemoryError, no kill, no long wait.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import pickle
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import torch
from ending import finish

from imujoco_minari.envs.mjcf import canonical_mjcf
from imujoco_minari.envs.untrusted_mjcf import check_mjcf
from imujoco_minari.errors import ImujocoError
from imujoco_minari.importing.external import read_source
from imujoco_minari.policies import read_actor
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.storage import file_format
from imujoco_minari.storage.metadata import complete_metadata
from imujoco_minari.variants import Variant
from imujoco_minari.verification import inspect, verify

sys.path.insert(0, str(Path(__file__).parents[1]))
from policy_zips import saved, write_zip

# Beyond what the process has when it starts. A child that reads a policy or a model may add 1 GiB.
MEMORY, SECONDS = 3 * 2**30, 60
ID = "imujoco/hopper-base-random-v0"


def dataset(folder: Path, rng: random.Random) -> Callable[[], bool]:
    """A dataset with one array, attribute or group that claims much; read by `verify` or `combine`."""
    data = Path(os.environ["MINARI_DATASETS_PATH"]) / ID / "data"
    with h5py.File(file_format.main_file(data), "a") as file:
        episode = file[f"episode_{rng.randrange(3)}"]
        key = rng.choice(file_format.ARRAYS)
        shape = tuple(10 ** rng.randrange(1, 7) for _ in range(rng.randrange(1, 4)))
        kind = rng.choice(["claim", "packed", "attributes", "groups", "depth", "text", "metadata"])
        if kind == "claim":
            del episode[key]
            episode.create_dataset(
                key, shape=shape, chunks=(5,) * len(shape), dtype=rng.choice(["f8", "S999"])
            )
        elif kind == "packed":
            del episode[key]
            rows = 10 ** rng.randrange(5, 8)
            episode.create_dataset(key, data=np.zeros(rows, "u1"), compression="gzip", compression_opts=9)
        elif kind == "attributes":
            for number in range(10 ** rng.randrange(1, 4)):
                episode.attrs[f"x{number}"] = np.zeros(10 ** rng.randrange(0, 4))
        elif kind == "groups":
            for number in range(10 ** rng.randrange(1, 4)):
                rng.choice([file, episode]).create_group(f"x{number}")
        elif kind == "depth":
            group = episode
            for _ in range(10 ** rng.randrange(1, 4)):
                group = group.create_group("x")
        elif kind == "text":
            episode.attrs["variant"] = "x" * 10 ** rng.randrange(1, 5)
        else:
            path = data / "metadata.json"
            metadata = json.loads(path.read_text())
            key = rng.choice(sorted(metadata))
            size = 10 ** rng.randrange(1, 7)
            value = rng.choice(['"' + "x" * size + '"', "[" * size, "9" * min(size, 4000), "1e999"])
            text = json.dumps(metadata | {key: "HERE"}).replace('"HERE"', value)
            path.write_text(text)
    if rng.random() < 0.7:
        with contextlib.suppress(ValueError, RecursionError):
            complete_metadata(data, {})
    read = rng.choice([verify, verify, lambda name: combine_datasets([name], "imujoco/hopper-new-v0")])
    return lambda: bool(read(ID))


def npz(folder: Path, rng: random.Random) -> Callable[[], bool]:
    """A zip of arrays that unpack to much, or only claim to."""
    path = folder / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for number in range(rng.randrange(1, 8)):
            rows = 10 ** rng.randrange(1, 9)
            header = {"descr": rng.choice(["<f8", "|u1", "<f4"]), "fortran_order": False, "shape": (rows, 18)}
            content = io.BytesIO()
            np.lib.format.write_array_header_1_0(content, header)
            content.write(bytes(rng.choice([0, min(rows, 10**7)])))
            archive.writestr("data.npy" if number == 0 else f"a{number}.npy", content.getvalue())
    return lambda: bool(read_source(str(path), "hopper"))


def policy(folder: Path, rng: random.Random) -> Callable[[], bool]:
    """A policy whose tensors share one storage many times, or whose pickle doubles at each level."""
    tensor = torch.zeros(2 ** rng.randrange(1, 22))
    if rng.random() < 0.5:
        shape = (10 ** rng.randrange(1, 9), len(tensor))
        state = {f"actor.x{n}": tensor.expand(shape) for n in range(10 ** rng.randrange(0, 4))}
        pth = saved(state | {"actor.mu.weight": tensor})
    else:
        nested: tuple[object, ...] = ("x",)
        for _ in range(rng.randrange(1, 60)):
            nested = (nested, nested)
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w") as archive:
            # As a key of a dict, the tuple is hashed, which takes a time of its own at each level.
            content = pickle.dumps(nested, protocol=2).removesuffix(b".")
            archive.writestr("archive/data.pkl", b"\x80\x02}" + content[2:] + b"K\x01s.")
            archive.writestr("archive/version", "3")
        pth = file.getvalue()
    path = write_zip(folder / "a.zip", pth)
    return lambda: bool(read_actor(path))


def mjcf(folder: Path, rng: random.Random) -> Callable[[], bool]:
    """A robot's model of which one number is huge, or one element stands very often."""
    text = canonical_mjcf(Variant.parse("hopper-base"))
    huge = rng.choice(["1e9", "+900000000", "40000", "-1", "1e308", "2000000000", "nan"])
    option = rng.choice(
        [
            f'<size nstack="{huge}"/>',
            f'<size memory="{rng.choice(["1T", "64G", huge])}"/>',
            f'<size njmax="{huge}" nconmax="{huge}"/>',
            f'<option iterations="{huge}" tolerance="0"/>',
            f'<option timestep="{huge}"/>',
            f'<asset><texture name="t" type="2d" builtin="flat" width="{huge}" height="{huge}"/></asset>',
            "<asset>"
            + "".join(
                f'<texture name="t{n}" type="cube" builtin="flat" width="{2 ** rng.randrange(13)}"/>'
                for n in range(rng.randrange(200))
            )
            + "</asset>",
            "<worldbody>" + '<geom size="1"/>' * rng.randrange(3000) + "</worldbody>",
            "<worldbody>" + "<body>" * rng.randrange(2000) + "</worldbody>",
        ]
    )
    text = text.replace("</mujoco>", f"{option}</mujoco>")
    return lambda: check_mjcf(text, "campaign") is not None


TARGETS = {each.__name__: each for each in (dataset, npz, policy, mjcf)}


def end_of(read: Callable[[], bool]) -> str:
    """Read an input in a forked process with little memory; return how that ended."""
    receiver, sender = os.pipe()
    pid = os.fork()
    if pid == 0:
        end = "?"
        try:
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            limit = pages * resource.getpagesize() + MEMORY
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
            resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            end = "finding or result" if read() else "nothing"
        except ImujocoError:
            end = "refused"
        except BaseException as error:
            end = f"RAISED {error!r}"[:300]
        finally:
            os.write(sender, end.encode())
            os._exit(0)
    os.close(sender)
    with os.fdopen(receiver, "rb") as stream:
        text = stream.read().decode()
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    return f"KILLED {signal.Signals(-code).name}" if code < 0 else text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=120)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    ends: Counter[str] = Counter()
    failures: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        os.environ["MINARI_DATASETS_PATH"] = str(work / "sound")
        publish("hopper-base", tier="random", episodes=3)
        assert not inspect(work / "sound" / ID / "data")
        os.environ["MINARI_DATASETS_PATH"] = str(work / "root")
        start = time.monotonic()
        while time.monotonic() - start < options.seconds:
            shutil.rmtree(work / "root", ignore_errors=True)
            shutil.copytree(work / "sound", work / "root")
            name = rng.choice(sorted(TARGETS))
            end = end_of(TARGETS[name](work, rng))
            ends[f"{name}: {end.split(' ')[0]}"] += 1
            if end[0].isupper() or end == "?":
                failures.append(f"{name}, input {sum(ends.values())}: {end}")
    finish(f"{sum(ends.values())} inputs, {len(failures)} failures", ends, failures)


if __name__ == "__main__":
    main()
