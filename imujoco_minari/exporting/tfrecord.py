"""TFRecord files and ``tf.train.Example`` messages, without TensorFlow.

A record is the length of its message, the masked CRC-32C of the length, the message, and the masked
CRC-32C of the message, as in TensorFlow's ``record_writer.cc``. A message has the wire format of
Protocol Buffers.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import missing_dependency


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
