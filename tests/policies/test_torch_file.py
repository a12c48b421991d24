"""Files of ``torch.save`` and Stable-Baselines3 zips, read without torch and without unpickling."""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imujoco_minari.errors import ImujocoError, PolicyError
from imujoco_minari.policies import read_actor
from imujoco_minari.policies.torch_file import TorchFile

torch = pytest.importorskip("torch")


def saved(value: Any, **options: Any) -> bytes:
    file = io.BytesIO()
    torch.save(value, file, **options)
    return file.getvalue()


def actor_state() -> dict[str, Any]:
    generator = torch.Generator().manual_seed(0)
    shapes = {
        "latent_pi.0.weight": (8, 11),
        "latent_pi.0.bias": (8,),
        "mu.weight": (3, 8),
        "mu.bias": (3,),
        "log_std.weight": (3, 8),
        "log_std.bias": (3,),
    }
    return {f"actor.{name}": torch.randn(shape, generator=generator) for name, shape in shapes.items()}


def write_zip(path: Path, pth: bytes, data: str = "{}") -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", data)
        archive.writestr("policy.pth", pth)
    return path


class Touch:
    """Its pickle calls ``os.system`` when it is loaded."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> Any:
        import os

        return os.system, (f"touch {self.trace}",)


class TestTensors:
    def test_every_kind_equals_torchs_own_reading(self) -> None:
        state = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.ReLU()).state_dict()
        state["scalar"] = torch.tensor(2.5)
        state["half"] = torch.arange(6, dtype=torch.float16).reshape(2, 3)
        state["whole"] = torch.arange(6)
        state["flags"] = torch.tensor([True, False])
        state["window"] = torch.arange(20.0).reshape(4, 5)[1:3, 2:]
        state["turned"] = torch.arange(6.0).reshape(2, 3).T
        state["parameter"] = torch.nn.Parameter(torch.ones(2))
        file = TorchFile(io.BytesIO(saved(state)))
        assert set(file.tensors) == set(state)
        for name, tensor in state.items():
            array = file.read(name)
            assert array.dtype == tensor.detach().numpy().dtype
            assert np.array_equal(array, tensor.detach().numpy())

    def test_what_is_no_tensor_is_left_out(self) -> None:
        file = TorchFile(io.BytesIO(saved({"a": torch.ones(1), "b": 7, "c": [1, 2], 3: torch.ones(1)})))
        assert set(file.tensors) == {"a"}

    @pytest.mark.parametrize(
        ("value", "message"),
        [
            ([1, 2], "no state dict"),
            ({"a": complex(1, 2)}, "would call builtins.complex|would call __builtin__.complex"),
            ({"a": torch.zeros(1, dtype=torch.complex64)}, "of a kind"),
        ],
    )
    def test_other_things_are_refused(self, value: Any, message: str) -> None:
        with pytest.raises(PolicyError, match=message):
            TorchFile(io.BytesIO(saved(value)))

    def test_the_old_format_is_refused(self) -> None:
        with pytest.raises(PolicyError, match=r"torch\.save"):
            TorchFile(io.BytesIO(saved({}, _use_new_zipfile_serialization=False)))

    def test_a_window_larger_than_its_storage_is_refused(self) -> None:
        wide = torch.ones(1).expand(10**9, 10**9)
        file = TorchFile(io.BytesIO(saved({"a": wide})))
        with pytest.raises(PolicyError, match="does not fit its storage"):
            file.read("a")


class TestZips:
    def test_an_actor(self, tmp_path: Path) -> None:
        state = actor_state()
        actor = read_actor(write_zip(tmp_path / "a.zip", saved(state)))
        assert actor.algorithm == "SAC"
        for name, array in actor.weights.items():
            assert np.array_equal(array, state[f"actor.{name}"].numpy())

    def test_tqc_is_known_by_its_critic(self, tmp_path: Path) -> None:
        state = actor_state() | {"critic.qf0.0.bias": torch.ones(8), "critic.qf0.2.bias": torch.ones(25)}
        assert read_actor(write_zip(tmp_path / "a.zip", saved(state))).algorithm == "TQC"

    def test_a_pickle_that_would_touch_a_file_leaves_no_trace(self, tmp_path: Path) -> None:
        trace = tmp_path / "trace"
        path = write_zip(tmp_path / "a.zip", saved(actor_state() | {"actor.x": Touch(trace)}))
        with pytest.raises(PolicyError, match=r"would call (posix|os)\.system: refused"):
            read_actor(path)
        assert not trace.exists()
        # The twin that shows that the pickle bites.
        with zipfile.ZipFile(path) as archive:
            torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=False)
        assert trace.exists()

    def test_pickles_in_data_are_not_looked_at(self, tmp_path: Path) -> None:
        trace = tmp_path / "trace"
        data = json.dumps({"policy_class": {":serialized:": pickle.dumps(Touch(trace)).hex()}})
        read_actor(write_zip(tmp_path / "a.zip", saved(actor_state()), data))
        assert not trace.exists()

    @pytest.mark.parametrize("inner", [False, True])
    def test_a_bomb_is_refused(self, tmp_path: Path, inner: bool) -> None:
        path = tmp_path / "a.zip"
        bomb = io.BytesIO()
        with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("archive/data.pkl" if inner else "policy.pth", bytes(2**27))
            archive.writestr("data", "{}")
        if inner:
            write_zip(path, bomb.getvalue())
        else:
            path.write_bytes(bomb.getvalue())
        with pytest.raises(PolicyError, match="would unpack to 134217728 bytes"):
            read_actor(path)

    def test_a_file_without_bounds_is_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "a.zip"
        with path.open("wb") as file:
            file.truncate(2**30)
        with pytest.raises(PolicyError, match="the limit is"):
            read_actor(path)

    def test_unusual_compression_is_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "a.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as archive:
            archive.writestr("data", "{}")
            archive.writestr("policy.pth", saved(actor_state()))
        with pytest.raises(PolicyError, match="compressed in a way"):
            read_actor(path)

    @pytest.mark.parametrize("seed", range(150))
    def test_damage_is_refused_or_harmless(self, tmp_path: Path, seed: int) -> None:
        rng = np.random.default_rng(seed)
        pth = bytearray(saved(actor_state()))
        for _ in range(int(rng.integers(1, 8))):
            pth[int(rng.integers(len(pth)))] = int(rng.integers(256))
        raw = write_zip(tmp_path / "a.zip", bytes(pth)).read_bytes()
        if seed % 3 == 0:
            raw = raw[: int(rng.integers(len(raw)))]
        (tmp_path / "a.zip").write_bytes(raw)
        try:
            actor = read_actor(tmp_path / "a.zip")
        except ImujocoError:
            return
        assert actor.observation_size == 11
