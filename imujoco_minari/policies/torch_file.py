"""Tensors out of a file of ``torch.save``, without torch and without unpickling.

Such a file is a zip of raw storages and of a pickle that says which tensors they make. A pickle is a
program; here it is read by a machine that knows the few instructions of a state dict, takes a global
for the name that it is, never imports or calls one, and refuses everything else.
"""

from __future__ import annotations

import pickletools
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from imujoco_minari.errors import PolicyError

# A SAC policy's pickle has 5 kB, its largest storage 256 kB.
MAX_PICKLE_BYTES = 2**20
MAX_STORAGE_BYTES = 2**26

_DTYPES = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "<i1",
    "ByteStorage": "<u1",
    "BoolStorage": "?",
}
_VALUES = frozenset(
    ("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8")
)
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_MARK = object()


@dataclass(frozen=True)
class Tensor:
    """A tensor as the pickle describes it: a strided window into a storage."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


@dataclass(frozen=True)
class _Storage:
    key: str
    dtype: str
    count: int


@dataclass(frozen=True)
class _Global:
    """A name that a pickle would import."""

    module: str
    name: str


class TorchFile:
    """An open file of ``torch.save`` that holds a state dict.

    Args:
        file: open for reading, as long as tensors are read.

    Attributes:
        tensors: the tensors of the state dict, by name; nothing of them is read yet.

    Raises:
        PolicyError: when the file is no state dict of plain tensors.
    """

    def __init__(self, file: BinaryIO) -> None:
        try:
            self._zip = zipfile.ZipFile(file)
            pickles = [name for name in self._zip.namelist() if name.endswith("/data.pkl")]
            if len(pickles) != 1:
                raise PolicyError("not a file of torch.save, of version 1.6 or later")
            self._prefix = pickles[0].removesuffix("data.pkl")
            if (
                f"{self._prefix}byteorder" in self._zip.namelist()
                and self._entry("byteorder", 6) != b"little"
            ):
                raise PolicyError("saved on a big-endian machine, which is not supported")
            state = _interpret(self._entry("data.pkl", MAX_PICKLE_BYTES))
        except (zipfile.BadZipFile, ValueError, EOFError, NotImplementedError, RuntimeError) as error:
            if isinstance(error, PolicyError):
                raise
            raise PolicyError(f"not a readable file of torch.save: {str(error)[:120]}") from None
        if not isinstance(state, dict):
            raise PolicyError("holds no state dict")
        self.tensors: Mapping[str, Tensor] = {
            key: value for key, value in state.items() if isinstance(value, Tensor)
        }

    def read(self, name: str) -> NDArray[Any]:
        """Return one tensor as an array of its shape.

        Raises:
            PolicyError: when its storage is missing or too small for it.
        """
        tensor = self.tensors[name]
        storage = tensor.storage
        dtype = np.dtype(storage.dtype)
        last = tensor.offset + sum(
            (length - 1) * stride for length, stride in zip(tensor.shape, tensor.strides, strict=True)
        )
        if (
            prod(tensor.shape) > storage.count
            or (tensor.shape and 0 in tensor.shape)
            or last >= storage.count
        ):
            raise PolicyError(f"{name[:80]} of shape {tensor.shape} does not fit its storage")
        try:
            raw = self._entry(f"data/{storage.key}", MAX_STORAGE_BYTES)
        except (zipfile.BadZipFile, ValueError, EOFError, NotImplementedError, RuntimeError) as error:
            raise PolicyError(f"{name[:80]} cannot be read: {str(error)[:120]}") from None
        if len(raw) < storage.count * dtype.itemsize:
            raise PolicyError(f"{name[:80]}: its storage holds {len(raw)} bytes, fewer than stated")
        flat = np.frombuffer(raw, dtype, count=storage.count)[tensor.offset :]
        strides = tuple(stride * dtype.itemsize for stride in tensor.strides)
        return np.array(np.lib.stride_tricks.as_strided(flat, tensor.shape, strides, writeable=False))

    def _entry(self, name: str, limit: int) -> bytes:
        return read_entry(self._zip, self._prefix + name, limit)


def read_entry(archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """Return one entry of a zip, which unpacks to ``limit`` bytes at most.

    Raises:
        PolicyError: when there is no such entry, or it is too large, or packed in an unusual way.
    """
    try:
        info = archive.getinfo(name)
    except KeyError:
        raise PolicyError(f"no {name[:80]} inside") from None
    if info.file_size > limit:
        raise PolicyError(f"{name[:80]} would unpack to {info.file_size} bytes; the limit is {limit}")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise PolicyError(f"{name[:80]} is compressed in a way that no policy is")
    with archive.open(info) as stream:
        return stream.read(limit)


def _interpret(program: bytes) -> Any:
    """Return what a pickle of a state dict describes: a dict, its tensors as :class:`Tensor`."""
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    for opcode, argument, _ in pickletools.genops(program):
        name = opcode.name
        if name in ("PROTO", "FRAME"):
            continue
        if name == "STOP":
            return _pop(stack)
        if name in _VALUES:
            stack.append(argument)
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name == "MARK":
            stack.append(_MARK)
        elif name in ("EMPTY_DICT", "EMPTY_LIST"):
            stack.append({} if name == "EMPTY_DICT" else [])
        elif name in ("BINPUT", "LONG_BINPUT", "MEMOIZE"):
            place = len(memo) if argument is None else int(argument)
            memo[place] = stack[-1] if stack else _pop(stack)
        elif name in ("BINGET", "LONG_BINGET"):
            if argument not in memo:
                raise PolicyError("holds a broken pickle")
            stack.append(memo[argument])
        else:
            _combine(name, argument, stack)
    raise PolicyError("holds a broken pickle")


def _combine(name: str, argument: Any, stack: list[Any]) -> None:
    """Do an instruction that takes values from the stack."""
    if name in _TUPLES:
        items = [_pop(stack) for _ in range(_TUPLES[name])]
        stack.append(tuple(reversed(items)))
    elif name == "TUPLE":
        stack.append(tuple(_to_mark(stack)))
    elif name == "GLOBAL":
        module, _, attribute = argument.partition(" ")
        stack.append(_Global(module, attribute))
    elif name == "STACK_GLOBAL":
        attribute, module = _pop(stack), _pop(stack)
        stack.append(_Global(str(module), str(attribute)))
    elif name in ("SETITEM", "SETITEMS"):
        items = _to_mark(stack) if name == "SETITEMS" else [_pop(stack), _pop(stack)][::-1]
        _fill(stack, items)
    elif name in ("APPEND", "APPENDS"):
        # Lists occur in a state dict's metadata only, of which nothing is used.
        if name == "APPENDS":
            _to_mark(stack)
        else:
            _pop(stack)
    elif name == "BINPERSID":
        stack.append(_storage(_pop(stack)))
    elif name == "REDUCE":
        arguments, function = _pop(stack), _pop(stack)
        stack.append(_rebuild(function, arguments))
    elif name == "BUILD":
        # Attributes of the dict: torch's versions of the modules, of which nothing is used.
        _pop(stack)
    else:
        raise PolicyError(f"its pickle holds {name}, which no state dict does")


def _pop(stack: list[Any]) -> Any:
    if not stack or stack[-1] is _MARK:
        raise PolicyError("holds a broken pickle")
    return stack.pop()


def _to_mark(stack: list[Any]) -> list[Any]:
    items: list[Any] = []
    while stack:
        item = stack.pop()
        if item is _MARK:
            return items[::-1]
        items.append(item)
    raise PolicyError("holds a broken pickle")


def _fill(stack: list[Any], items: list[Any]) -> None:
    target = stack[-1] if stack else None
    if not isinstance(target, dict) or len(items) % 2:
        raise PolicyError("holds a broken pickle")
    # Keys that are no names cannot be a tensor's; they are left out.
    target.update(
        (key, value) for key, value in zip(items[::2], items[1::2], strict=True) if isinstance(key, str)
    )


def _storage(identity: Any) -> _Storage:
    match identity:
        case ("storage", _Global("torch", str(kind)), str(key), str(), int(count)) if kind in _DTYPES:
            if count < 0 or not key.isdigit():
                raise PolicyError("holds a malformed storage")
            return _Storage(key, _DTYPES[kind], count)
    raise PolicyError("holds a storage of a kind that no policy has")


def _rebuild(function: Any, arguments: Any) -> Any:
    match function, arguments:
        case _Global("collections", "OrderedDict"), ():
            return {}
        case (
            _Global("torch._utils", "_rebuild_tensor_v2"),
            (_Storage() as storage, int(offset), tuple(shape), tuple(strides), *_),
        ):
            if (
                len(shape) != len(strides)
                or len(shape) > 8
                or any(type(number) is not int or number < 0 for number in (offset, *shape, *strides))
            ):
                raise PolicyError("holds a malformed tensor")
            return Tensor(storage, offset, shape, strides)
        case _Global("torch._utils", "_rebuild_parameter"), (Tensor() as tensor, *_):
            return tensor
    if isinstance(function, _Global):
        raise PolicyError(f"its pickle would call {function.module[:60]}.{function.name[:60]}: refused")
    raise PolicyError("holds a broken pickle")
