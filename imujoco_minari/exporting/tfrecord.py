"""TFRecord files and ``tf.train.Example`` messages, without TensorFlow.

A record is its length and the masked CRC-32C of that, its bytes and the masked CRC-32C of those (as
TensorFlow's ``record_writer.cc`` has it). A message is written in Protocol Buffers' wire format.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Reflected Castagnoli polynomial.
_POLYNOMIAL = 0x82F63B78
# Bytes that one lane of the vectorised checksum takes.
_BLOCK = 512


def record(message: bytes) -> bytes:
    """Return a TFRecord around a message."""
    length = struct.pack("<Q", len(message))
    return b"".join((length, _masked(length), message, _masked(message)))


def example(features: Mapping[str, str | NDArray[Any]]) -> bytes:
    """Return a serialised ``tf.train.Example``; arrays go in flat, floats as float32.

    Args:
        features: text, or arrays of floats, booleans or whole numbers.
    """
    entries = (_field(1, _field(1, name.encode()) + _field(2, _feature(v))) for name, v in features.items())
    return _field(1, b"".join(entries))


def crc32c(data: bytes) -> int:
    """Return the CRC-32C of ``data``."""
    # The checksum is linear, so blocks can be summed side by side from zero and then joined.
    table, shift = _table(), _shift()
    blocks = len(data) // _BLOCK
    lanes = np.frombuffer(data, np.uint8, blocks * _BLOCK).reshape(blocks, _BLOCK)
    sums = np.zeros(blocks, np.uint32)
    for column in np.ascontiguousarray(lanes.T):
        sums = table[(sums ^ column) & 0xFF] ^ (sums >> 8)
    total = 0xFFFFFFFF
    for block in sums.tolist():
        a, b, c, d = (shift[i][total >> 8 * i & 0xFF] for i in range(4))
        total = a ^ b ^ c ^ d ^ block
    words = table.tolist()
    for byte in data[blocks * _BLOCK :]:
        total = words[(total ^ byte) & 0xFF] ^ total >> 8
    return total ^ 0xFFFFFFFF


def _masked(data: bytes) -> bytes:
    checksum = crc32c(data)
    return struct.pack("<I", ((checksum >> 15 | checksum << 17) + 0xA282EAD8) & 0xFFFFFFFF)


@cache
def _table() -> NDArray[np.uint32]:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(_POLYNOMIAL), table >> 1)
    return table


@cache
def _shift() -> list[list[int]]:
    """Return, for each byte of a checksum, what its values become behind a block of zeros."""
    table = _table()
    sums = np.arange(256, dtype=np.uint32)[None, :] << (8 * np.arange(4, dtype=np.uint32)[:, None])
    for _ in range(_BLOCK):
        sums = table[sums & 0xFF] ^ (sums >> 8)
    return [[int(value) for value in row] for row in sums]


def _feature(value: str | NDArray[Any]) -> bytes:
    if isinstance(value, str):
        return _field(1, _field(1, value.encode()))
    if value.dtype.kind == "f":
        return _field(2, _field(1, value.astype("<f4").tobytes()))
    if value.dtype == bool:
        # A varint below 128 is its byte.
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
