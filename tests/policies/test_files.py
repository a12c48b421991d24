"""Policy files: what is read acts as in Stable-Baselines3; everything else is refused within limits."""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete
from policy_zips import good_data, saved, write_zip
from random_actors import random_actor
from safetensors.numpy import save_file
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.sac.policies import SACPolicy

from imujoco_minari.errors import ImujocoError, PolicyError, PolicyNotFoundError
from imujoco_minari.policies import Actor, files, read_actor

VECTOR = Box(-np.inf, np.inf, (11,), np.float64)
UNIT = Box(-1.0, 1.0, (3,), np.float32)


def state(widths: tuple[int, ...] = (256, 256)) -> dict[str, Any]:
    weights = random_actor(widths=widths).weights
    return {f"actor.{name}": torch.from_numpy(array) for name, array in weights.items()}


class Touch:
    """Its pickle calls ``os.system`` when it is loaded."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> Any:
        import os

        return os.system, (f"touch {self.trace}",)


class Robot(gym.Env[Any, Any]):
    """No physics, any spaces."""

    def __init__(self, observation_space: Any = VECTOR, action_space: Any = UNIT) -> None:
        self.observation_space, self.action_space = observation_space, action_space


class Scaled(FlattenExtractor):
    """A features extractor without weights, so that the state dict does not show it."""

    def forward(self, observations: Any) -> Any:
        return super().forward(observations) * 0.5


class Negated(SACPolicy):
    """A policy whose state dict is SACPolicy's."""

    def _predict(self, observation: Any, deterministic: bool = False) -> Any:
        return -super()._predict(observation, deterministic)


class ReLU(torch.nn.Module):
    """An activation of a known name that computes something else."""

    def forward(self, x: Any) -> Any:
        return -x


def sac(
    observations: Any = VECTOR,
    actions: Any = UNIT,
    *,
    policy: Any = "MlpPolicy",
    sde: bool = False,
    **kwargs: Any,
) -> Any:
    return SAC(
        policy,
        Robot(observations, actions),
        buffer_size=1,
        use_sde=sde,
        policy_kwargs={"net_arch": [16]} | kwargs,
        device="cpu",
    )


def sac_model(path: Path, model: Any) -> Path:
    model.save(path)
    return path


@pytest.mark.usefixtures("in_process")
class TestRealZips:
    @pytest.mark.parametrize(
        "make",
        [
            lambda: sac(),
            lambda: sac(net_arch={"pi": [32, 8], "qf": [16]}, n_critics=1),
            lambda: sac(features_extractor_class=FlattenExtractor, normalize_images=False),
            lambda: sac(Box(-5.0, 5.0, (11,), np.float32), log_std_init=-1.0),
            lambda: sac(activation_fn=torch.nn.SiLU, optimizer_class=torch.optim.AdamW),
            lambda: sac(policy=SACPolicy),
        ],
    )
    def test_an_actor_that_can_be_represented_acts_the_same(
        self, tmp_path: Path, make: Callable[[], Any]
    ) -> None:
        model = make()
        actor = read_actor(sac_model(tmp_path / "a.zip", model))
        assert actor.algorithm == "SAC"
        rng = np.random.default_rng(0)
        for observation in rng.normal(size=(20, 11)) * 3:
            expected, _ = model.predict(observation, deterministic=True)
            assert actor.act(observation, rng) == pytest.approx(expected, abs=1e-5)

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: sac(features_extractor_class=Scaled), "its features extractor is .*Scaled"),
            (lambda: sac(policy=Negated), "its policy class is of .*test_files"),
            (lambda: sac(activation_fn=ReLU), "its activation is .*test_files.ReLU"),
            (lambda: sac(activation_fn=torch.nn.LeakyReLU), "'LeakyReLU' is not supported; valid: ReLU"),
            (lambda: sac(net_arch=[]), "no hidden layer"),
            (lambda: sac(actions=Box(-2.0, 2.0, (3,))), "its actions lie between '.-2. -2. -2..' and"),
            (lambda: sac(actions=Box(-0.4, 0.4, (3,))), "valid: between -1 and 1"),
            (lambda: sac(actions=Box(0.0, 1.0, (3,))), "valid: between -1 and 1"),
            (
                lambda: sac(actions=Box(np.array([-1, -1, -1.01], "f4"), np.ones(3, "f4"))),
                "valid: between -1 and 1",
            ),
            (lambda: sac(sde=True), "gSDE"),
            (lambda: sac(sde=True, clip_mean=0.0), "gSDE"),
            (lambda: sac(Box(-1.0, 1.0, (1, 11))), "its observations have 2 dimensions"),
            (lambda: sac(Discrete(11)), "its observation space is .*Discrete"),
            (lambda: sac(Dict({"a": VECTOR}), policy="MultiInputPolicy"), "its observation space is .*Dict"),
            (lambda: TD3("MlpPolicy", Robot(), buffer_size=1), "policy class is of 'stable_baselines3.td3"),
            (lambda: DDPG("MlpPolicy", Robot(), buffer_size=1), "policy class is of 'stable_baselines3.td3"),
            (
                lambda: PPO("MlpPolicy", Robot(), policy_kwargs={"squash_output": False}, device="cpu"),
                "policy class is of 'stable_baselines3.common",
            ),
        ],
    )
    def test_another_actor_is_refused(self, tmp_path: Path, make: Callable[[], Any], message: str) -> None:
        with pytest.raises(PolicyError, match=message) as error:
            read_actor(sac_model(tmp_path / "a.zip", make()))
        assert "\n" not in str(error.value)
        assert len(str(error.value)) < 400

    def test_tqc_is_known_by_its_policy_class(self, tmp_path: Path) -> None:
        data = good_data() | {"policy_class": {"__module__": "sb3_contrib.tqc.policies"}}
        assert read_actor(write_zip(tmp_path / "a.zip", saved(state()), data)).algorithm == "TQC"

    @pytest.mark.parametrize("name", ["policy_class", "policy_kwargs", "observation_space", "action_space"])
    def test_a_zip_that_does_not_state_what_decides_the_action_is_refused(
        self, tmp_path: Path, name: str
    ) -> None:
        data = {key: value for key, value in good_data().items() if key != name}
        with pytest.raises(PolicyError, match=f"its data states no {name}"):
            read_actor(write_zip(tmp_path / "a.zip", saved(state()), data))


class TestHostileZips:
    def test_a_pickle_that_would_touch_a_file_leaves_no_trace(self, tmp_path: Path) -> None:
        trace = tmp_path / "trace"
        path = write_zip(tmp_path / "a.zip", saved(state() | {"actor.x": Touch(trace)}))
        with pytest.raises(PolicyError, match=r"names '(posix|os)\.system': refused"):
            read_actor(path)
        assert not trace.exists()
        # The same pickle does touch the file where it is loaded.
        with zipfile.ZipFile(path) as archive:
            torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=False)
        assert trace.exists()

    @pytest.mark.usefixtures("in_process")
    @pytest.mark.parametrize("protocol", [0, 2, 4])
    def test_a_bare_pickle_leaves_no_trace(self, tmp_path: Path, protocol: int) -> None:
        trace = tmp_path / "trace"
        path = write_zip(tmp_path / "a.zip", pickle.dumps(Touch(trace), protocol))
        with pytest.raises(PolicyError, match="cannot be read as a policy"):
            read_actor(path)
        assert not trace.exists()

    def test_pickles_in_data_are_not_loaded(self, tmp_path: Path) -> None:
        trace = tmp_path / "trace"
        data = good_data()
        for value in data.values():
            if isinstance(value, dict):
                value[":serialized:"] = pickle.dumps(Touch(trace)).hex()
        actor = read_actor(write_zip(tmp_path / "a.zip", saved(state()), data))
        assert actor.sha256 == random_actor().sha256
        assert not trace.exists()

    @pytest.mark.usefixtures("in_process")
    @pytest.mark.parametrize("seed", range(150))
    def test_damage_is_refused_or_harmless(self, tmp_path: Path, seed: int) -> None:
        rng = np.random.default_rng(seed)
        pth = bytearray(saved(state(widths=(16, 16))))
        for _ in range(int(rng.integers(1, 8))):
            # The pickle, which is at the front, is a small part of the file.
            last = 1500 if rng.random() < 0.7 else len(pth)
            pth[int(rng.integers(last))] = int(rng.integers(256))
        raw = write_zip(tmp_path / "a.zip", bytes(pth)).read_bytes()
        if seed % 3 == 0:
            raw = raw[: int(rng.integers(len(raw)))]
        (tmp_path / "a.zip").write_bytes(raw)
        try:
            actor = read_actor(tmp_path / "a.zip")
        except ImujocoError:
            return
        assert actor.observation_size == 11


def pickled(program: bytes, path: Path) -> Path:
    """Write a zip whose ``policy.pth`` holds a pickle and no storage."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a/data.pkl", program)
        archive.writestr("a/version", "3\n")
    return write_zip(path, file.getvalue())


def text(value: str) -> bytes:
    return b"X" + len(value).to_bytes(4, "little") + value.encode()


# A tuple holds the tuple before twice: 60 levels are 360 bytes, and 2**60 elements for a hash or a text.
DOUBLED = b")" + b"q\x01h\x01\x86" * 60
LARGE = b"\x8a\x06" + (10**11).to_bytes(6, "little")


class TestBombs:
    """Small files that ask for any amount of memory or time. The limits are lower here than in use."""

    @pytest.fixture(autouse=True)
    def low_limits(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(files, "MAX_MEMORY_BYTES", 2**26)
        monkeypatch.setattr(files, "MAX_SECONDS", 1)

    @pytest.mark.parametrize(
        ("program", "message"),
        [
            pytest.param(DOUBLED + text("x") + b"\x93.", "holds more than weights", id="as a module's name"),
            pytest.param(b"}" + DOUBLED + b"K\x01s.", "more than 1 seconds", id="as a key"),
            pytest.param(DOUBLED + b")R.", "more than (1 seconds|67108864 bytes)", id="as a function"),
            pytest.param(
                b"}" + text("actor.mu.weight") + b"ctorch\nFloatTensor\n" + LARGE + b"\x85Rs.",
                "more than 67108864 bytes of memory",
                id="a large tensor",
            ),
            pytest.param(
                b"}" + text("actor.mu.weight") + b"cbuiltins\nbytearray\n" + LARGE + b"\x85Rs.",
                "more than 67108864 bytes of memory",
                id="a large array of bytes",
            ),
        ],
    )
    def test_a_pickle(self, tmp_path: Path, program: bytes, message: str) -> None:
        path = pickled(b"\x80\x02" + program, tmp_path / "a.zip")
        assert path.stat().st_size < 1000
        with pytest.raises(PolicyError, match=message):
            read_actor(path)

    def test_many_storages_that_are_packed_well(self, tmp_path: Path) -> None:
        # 6 storages of 16 MiB, deflated within policy.pth: no single one is too large.
        plain, packed = saved({f"actor.{i}": torch.zeros(2**22) for i in range(6)}), io.BytesIO()
        with (
            zipfile.ZipFile(io.BytesIO(plain)) as source,
            zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as target,
        ):
            for name in source.namelist():
                target.writestr(name, source.read(name))
        path = write_zip(tmp_path / "a.zip", packed.getvalue())
        assert path.stat().st_size < 10_000
        # A busy processor reaches the limit of time first.
        with pytest.raises(PolicyError, match=r"more than (1 seconds|67108864 bytes)"):
            read_actor(path)

    def test_many_entries(self, tmp_path: Path) -> None:
        path = tmp_path / "a.zip"
        entry = b"PK\3\4" + bytes(26)
        central = b"PK\1\2" + bytes(24) + (1).to_bytes(2, "little") + bytes(16) + b"x"
        count = 400_000
        sizes = count.to_bytes(8, "little") * 2 + (count * len(central)).to_bytes(8, "little")
        end = b"PK\6\6" + (44).to_bytes(8, "little") + bytes(12) + sizes + len(entry).to_bytes(8, "little")
        locator = (
            b"PK\6\7" + bytes(4) + (len(entry) + count * len(central)).to_bytes(8, "little") + b"\1\0\0\0"
        )
        path.write_bytes(
            entry + central * count + end + locator + b"PK\5\6" + bytes(4) + b"\xff" * 12 + bytes(2)
        )
        with pytest.raises(PolicyError, match=r"more than (1 seconds|67108864 bytes)"):
            read_actor(path)

    @pytest.mark.usefixtures("in_process")
    def test_many_names_of_one_storage(self, tmp_path: Path) -> None:
        shared = torch.zeros(2**14)
        weights = {f"actor.{name}": shared for name in ("mu.weight", *map(str, range(2000)))}
        path = write_zip(tmp_path / "a.zip", saved(weights))
        with pytest.raises(PolicyError, match=r"its actor has 131137536 bytes; the limit is 67108864"):
            read_actor(path)

    @pytest.mark.usefixtures("in_process")
    def test_an_expanded_tensor(self, tmp_path: Path) -> None:
        wide = torch.ones(1).expand(10**9, 10**9)
        with pytest.raises(PolicyError, match="its actor has 4000000000000000000 bytes"):
            read_actor(write_zip(tmp_path / "a.zip", saved({"actor.mu.weight": wide})))

    @pytest.mark.usefixtures("in_process")
    @pytest.mark.parametrize(("name", "size"), [("policy.pth", 2**28 + 1), ("data", 2**24 + 1)])
    def test_an_entry_that_unpacks_to_too_much(self, tmp_path: Path, name: str, size: int) -> None:
        path = tmp_path / "a.zip"
        entries = {"data": json.dumps(good_data()).encode(), "policy.pth": b""} | {name: bytes(size)}
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for key, value in entries.items():
                archive.writestr(key, value)
        with pytest.raises(
            PolicyError, match=f"{name} would unpack to {size} bytes; the limit is {size - 1}"
        ):
            read_actor(path)

    @pytest.mark.parametrize("name", ["a.zip", "a.safetensors"])
    def test_a_large_file(self, tmp_path: Path, name: str) -> None:
        path = tmp_path / name
        with path.open("wb") as file:
            file.truncate(2**30)
        with pytest.raises(PolicyError, match="has 1073741824 bytes; the limit is"):
            read_actor(path)


class TestPaths:
    def test_a_str_is_a_path(self, tmp_path: Path) -> None:
        save_file(dict(random_actor().weights), tmp_path / "a.safetensors")
        assert isinstance(read_actor(str(tmp_path / "a.safetensors")), Actor)

    def test_a_missing_file_is_named(self) -> None:
        with pytest.raises(PolicyNotFoundError, match=r"no policy file at x\.zip"):
            read_actor("x.zip")
