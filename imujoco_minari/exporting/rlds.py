"""RLDS episodes as TFRecords, with the two JSON files that TensorFlow Datasets requires to read a folder.

``tensorflow_datasets.builder_from_directory(folder)`` opens it. Writing does not require TensorFlow. An
episode of T steps is stored as T + 1 steps. The last one has the final observation, and zeros for action and
reward, which RLDS ignores there. The episode was truncated if that step ``is_last`` and not ``is_terminal``.
Numbers are float32, the only float type of ``tf.train.Example``. No other data is lost.

A record is the length of its message, the masked CRC-32C of the length, the message, and the masked CRC-32C
of the message, as in TensorFlow's ``record_writer.cc``. A message is a ``tf.train.Example`` in Protocol
Buffers' wire format.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import missing_dependency
from imujoco_minari.loading import ATTRIBUTES, Arrays, Origin, Trajectory

VERSION = "1.0.0"
# A file is closed when it grows beyond this size (bytes).
_SHARD = 2**28

_FEATURES = "tensorflow_datasets.core.features"


def write(data: Arrays, target: Path, *, states_only: bool) -> None:
    """Write ``data`` to the new folder ``target``.

    Raises:
        DependencyError: when google-crc32c is not installed.
    """
    target.mkdir()
    name = "imujoco_" + (data.table[0].variant if len(data.table) == 1 else data.table[0].robot)
    name = name.replace("-", "_")
    records: list[bytes] = []
    lengths: list[int] = []
    size = written = 0
    # The name of each file has the number of files, which is known only at the end.
    for number, (episode, origin) in enumerate(zip(data.trajectories(), data.origins, strict=True)):
        message = _episode(episode, origin, number, states_only)
        records.append(record(message))
        size += len(message)
        if size > _SHARD or number == data.episodes - 1:
            (target / f"{len(lengths)}.part").write_bytes(b"".join(records))
            lengths.append(len(records))
            written += size
            records, size = [], 0
    for number in range(len(lengths)):
        shard = f"{name}-train.tfrecord-{number:05d}-of-{len(lengths):05d}"
        (target / f"{number}.part").rename(target / shard)
    _json(target / "dataset_info.json", _info(name, data, lengths, written))
    _json(target / "features.json", _features(data, states_only))


def _episode(episode: Trajectory, origin: Origin, number: int, states_only: bool) -> bytes:
    steps = len(episode.rewards)
    first, last = np.zeros(steps + 1, bool), np.zeros(steps + 1, bool)
    first[0] = last[-1] = True
    features: dict[str, Any] = {
        "steps/observation": episode.observations,
        "steps/is_first": first,
        "steps/is_last": last,
        "steps/is_terminal": last & episode.terminated,
        "steps/discount": np.where(last & episode.terminated, 0.0, 1.0),
        "metadata/episode": np.array([number]),
    }
    if not states_only:
        features["steps/action"] = np.concatenate((episode.actions, np.zeros_like(episode.actions[:1])))
        features["steps/reward"] = np.append(episode.rewards, 0.0)
    for name in ATTRIBUTES:
        value = getattr(origin, name)
        features[f"metadata/{name}"] = value if isinstance(value, str) else np.array([float(value)])
    return example(features)


def _info(name: str, data: Arrays, lengths: list[int], size: int) -> dict[str, Any]:
    return {
        "description": "iMuJoCo, rebuilt: " + ", ".join(origin.variant for origin in data.table[:10]),
        "fileFormat": "tfrecord",
        "name": name,
        "version": VERSION,
        "splits": [
            {
                "filepathTemplate": "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}",
                "name": "train",
                "numBytes": str(size),
                "shardLengths": [str(length) for length in lengths],
            }
        ],
    }


def _features(data: Arrays, states_only: bool) -> dict[str, Any]:
    flag, number = _tensor("bool"), _tensor("float32")
    step = {
        "observation": _tensor("float32", data.observations.shape[1]),
        "discount": number,
        "is_first": flag,
        "is_last": flag,
        "is_terminal": flag,
    }
    if not states_only:
        step |= {"action": _tensor("float32", data.actions.shape[1]), "reward": number}
    text = {"pythonClassName": f"{_FEATURES}.text_feature.Text", "text": {}}
    metadata = {name: number if name == "percent" else text for name in ATTRIBUTES}
    steps = {
        "pythonClassName": f"{_FEATURES}.dataset_feature.Dataset",
        "sequence": {"feature": _dict(step), "length": "-1"},
    }
    return _dict({"steps": steps, "metadata": _dict(metadata | {"episode": _tensor("int64")})})


def _tensor(dtype: str, *shape: int) -> dict[str, Any]:
    dimensions = {"dimensions": [str(size) for size in shape]} if shape else {}
    return {
        "pythonClassName": f"{_FEATURES}.tensor_feature.Tensor",
        "tensor": {"dtype": dtype, "encoding": "none", "shape": dimensions},
    }


def _dict(features: dict[str, Any]) -> dict[str, Any]:
    return {
        "pythonClassName": f"{_FEATURES}.features_dict.FeaturesDict",
        "featuresDict": {"features": features},
    }


def _json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", "utf-8")


def record(message: bytes) -> bytes:
    """Return a TFRecord around a message.

    Raises:
        DependencyError: when google-crc32c is not installed.
    """
    length = struct.pack("<Q", len(message))
    return b"".join((length, _masked_crc(length), message, _masked_crc(message)))


def example(features: Mapping[str, str | NDArray[Any]]) -> bytes:
    """Return a serialised ``tf.train.Example``; arrays are flattened, and floats become float32.

    Args:
        features: name -> text, or an array of floats, booleans or integers.
    """
    entries = (_field(1, _field(1, name.encode()) + _field(2, _feature(v))) for name, v in features.items())
    return _field(1, b"".join(entries))


def _masked_crc(data: bytes) -> bytes:
    try:
        from google_crc32c import value as crc32c
    except ImportError:
        raise missing_dependency("google-crc32c", "rlds", "the format rlds") from None
    checksum = crc32c(data)
    return struct.pack("<I", ((checksum >> 15 | checksum << 17) + 0xA282EAD8) & 0xFFFFFFFF)


def _feature(value: str | NDArray[Any]) -> bytes:
    if isinstance(value, str):
        return _field(1, _field(1, value.encode()))
    if value.dtype.kind == "f":
        return _field(2, _field(1, value.astype("<f4").tobytes()))
    if value.dtype == bool:
        # A varint below 128 is one byte, the number itself.
        return _field(3, _field(1, value.astype(np.uint8).tobytes()))
    return _field(3, _field(1, b"".join(_varint(int(number) & (1 << 64) - 1) for number in value.flat)))


def _field(number: int, content: bytes) -> bytes:
    """Return a length-delimited field."""
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)
