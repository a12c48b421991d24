"""What comes from outside, by the hundred: an ImujocoError or a finding comes of it, and nothing else.

`scripts/test-fuzz` does the same by the thousand, guided by coverage.
"""

from __future__ import annotations

import contextlib
import json
import zipfile
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from policy_zips import write_zip

from imujoco_minari.envs.untrusted_mjcf import check_text
from imujoco_minari.errors import DatasetError, ImujocoError
from imujoco_minari.importing.safe_unpack import open_zip, read_npz, unpack
from imujoco_minari.policies import read_actor
from imujoco_minari.policies.sb3_reader import read_zip
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.storage import minari_root
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.variants import Variant, parse_dataset_id, parse_specification
from imujoco_minari.verification import inspect
from imujoco_minari.verification.identity import loadable

# A test's folder serves all its examples, which write one file after the other.
several = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=10), inner, max_size=4),
    max_leaves=10,
)
ATTRIBUTES = st.one_of(
    st.integers(-(2**63), 2**63 - 1),
    st.floats(),
    st.booleans(),
    st.text(max_size=20).filter(lambda text: "\0" not in text),
    st.binary(max_size=20).map(np.void).filter(lambda value: value.nbytes > 0),
    st.lists(st.integers(-5, 5), max_size=4),
)


class TestText:
    @given(st.text(max_size=80) | st.from_regex(r"(hopper|walker2d)-[a-z]{3,9}(inc|dec)_[0-9]{1,5}_[a-z_]*"))
    def test_ids(self, text: str) -> None:
        for parse in (Variant.parse, parse_dataset_id, minari_root.dataset_folder):
            with contextlib.suppress(ImujocoError):
                parse(text)

    @given(st.text(max_size=200) | JSON.map(json.dumps))
    def test_catalogues(self, text: str) -> None:
        with pytest.raises(ImujocoError):
            parse_specification(text, "hostile.toml")

    @given(st.text(max_size=200) | st.from_regex(r"<mujoco>(<[a-z]+ [a-z]+='[0-9./a]*'/>){0,3}</mujoco>"))
    def test_models(self, text: str) -> None:
        with contextlib.suppress(ImujocoError):
            check_text(text, "hostile")

    @several
    @given(JSON.map(json.dumps) | st.text(max_size=60))
    def test_metadata(self, tmp_path: Path, text: str) -> None:
        (tmp_path / "metadata.json").write_text(text, "utf-8", "surrogatepass")
        assert list(loadable(read_metadata(tmp_path)))

    @given(JSON, JSON)
    def test_metadata_within_metadata(self, spec: Any, space: Any) -> None:
        metadata = {key: json.dumps(spec) for key in ("env_spec", "eval_env_spec")}
        metadata |= {"observation_space": json.dumps(space), "action_space": space}
        assert list(loadable(metadata))


class TestFiles:
    @several
    @given(st.binary(max_size=300))
    def test_noise(self, tmp_path: Path, raw: bytes) -> None:
        for name, read in (
            ("a.zip", read_actor),
            ("a.safetensors", read_actor),
            ("a.npz", read_npz),
        ):
            (tmp_path / name).write_bytes(raw)
            with pytest.raises(ImujocoError):
                read(tmp_path / name)
        assert read_zip(str(write_zip(tmp_path / "b.zip", raw))).startswith(b'{"refused": ')
        (tmp_path / "main_data.hdf5").write_bytes(raw)
        (tmp_path / "metadata.json").write_text("{}")
        assert inspect(tmp_path)

    def test_a_zip_that_python_only_nearly_takes_for_one(self, tmp_path: Path) -> None:
        # Found by fuzzing: is_zipfile() itself raises on an archive that spans disks.
        raw = b"PK\6\7" + b"\1\0\0\0" + bytes(8) + b"\2\0\0\0" + b"PK\5\6" + bytes(18)
        (tmp_path / "a.zip").write_bytes(raw)
        with pytest.raises(zipfile.BadZipFile):
            zipfile.is_zipfile(tmp_path / "a.zip")
        with pytest.raises(ImujocoError, match="is no policy"):
            read_actor(tmp_path / "a.zip")

    @several
    @given(
        st.binary(max_size=100),
        st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=30),
    )
    def test_archives_of_any_names(self, tmp_path: Path, raw: bytes, name: str) -> None:
        path = tmp_path / "a.zip"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(name, raw)
        with open_zip(path) as opened:
            (entry,) = opened.namelist()
            unpack(opened, entry, tmp_path / "out")
        assert (tmp_path / "out").read_bytes() == raw
        (tmp_path / "out").unlink()

    @several
    @given(
        st.dictionaries(
            st.sampled_from(
                ("id", "seed", "total_steps", "variant", "robot", "percent", "tier", "sha256", "x")
            ),
            ATTRIBUTES,
        ),
        st.sampled_from(("observations", "actions", "rewards", "terminations", "truncations", "infos")),
        st.sampled_from(("f8", "f4", "i8", "?", "S3", "V4")),
        st.lists(st.integers(0, 12), max_size=3),
    )
    def test_hdf5_files_of_any_content(
        self, tmp_path: Path, attributes: dict[str, Any], name: str, dtype: str, shape: list[int]
    ) -> None:
        spaces = ((11, "float64"), (3, "float32"))
        boxes = [
            json.dumps({"type": "Box", "dtype": dtype, "shape": [n], "low": [-1.0] * n, "high": [1.0] * n})
            for n, dtype in spaces
        ]
        metadata = {
            "data_format": "hdf5",
            "dataset_id": "imujoco/x-v0",
            "minari_version": "0.5",
            "observation_space": boxes[0],
            "action_space": boxes[1],
            "total_episodes": 1,
            "total_steps": 3,
        }
        (tmp_path / "metadata.json").write_text(json.dumps(metadata))
        with h5py.File(tmp_path / "main_data.hdf5", "w") as file:
            file.attrs.update(attributes)
            group = file.create_group("episode_0")
            for key, value in (
                ("observations", np.zeros((4, 11))),
                ("actions", np.zeros((3, 3), np.float32)),
                ("rewards", np.zeros(3)),
                ("terminations", np.array([False, False, True])),
                ("truncations", np.zeros(3, bool)),
            ):
                group[key] = value
            group.attrs.update(attributes)
            group.pop(name, None)
            group.create_dataset(name, tuple(shape), dtype)
        findings = inspect(tmp_path)
        assert findings
        assert not any("cannot be read" in finding.what for finding in findings), findings


class TestStockMinariIsNoSafer:
    """Why we check before we load: what hostile metadata does to who does not."""

    def test_loading_would_call_what_the_metadata_names(self, root: Path, tmp_path: Path) -> None:
        trace = tmp_path / "trace"
        data = root / "evil/x-v0/data"
        data.mkdir(parents=True)
        spec = {
            "id": "x-v0",
            "entry_point": "os:system",
            "kwargs": {"command": f"touch {trace}"},
            "additional_wrappers": [],
        }
        metadata = {"data_format": "hdf5", "dataset_id": "evil/x-v0", "env_spec": json.dumps(spec)}
        (data / "metadata.json").write_text(json.dumps(metadata))
        (data / "main_data.hdf5").touch()
        with pytest.raises(DatasetError, match="do not load it"):
            combine_datasets(["evil/x-v0"], "imujoco/new-v0")
        assert "do not load it" in "\n".join(map(str, inspect(data)))
        assert not trace.exists()
        with pytest.raises(TypeError, match="must inherit"):
            minari.load_dataset("evil/x-v0")
        assert trace.exists()
