"""Read files of `torch.save` without torch.load, which runs code of a hostile file: any before torch 2.6, and through
gaps of `weights_only=True` up to 2.9."""

import math
import os
import pickle
import sys
from collections import OrderedDict
from collections.abc import Callable
from io import BytesIO
from typing import Any, BinaryIO
from zipfile import ZipExtFile, ZipFile

import numpy as np
import torch
from torch import Tensor

_STORAGES = {
    "FloatStorage": torch.float32, "DoubleStorage": torch.float64, "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16, "LongStorage": torch.int64, "IntStorage": torch.int32,
    "ShortStorage": torch.int16, "CharStorage": torch.int8, "ByteStorage": torch.uint8, "BoolStorage": torch.bool,
}  # fmt: skip
_CODES = [
    getattr(pickle, name)
    for name in """
PROTO STOP MARK NONE NEWTRUE NEWFALSE BININT BININT1 BININT2 LONG1 BINFLOAT BINUNICODE TUPLE EMPTY_TUPLE TUPLE1 TUPLE2
TUPLE3 EMPTY_LIST APPEND APPENDS EMPTY_DICT SETITEM SETITEMS BINPUT LONG_BINPUT BINGET LONG_BINGET GLOBAL REDUCE BUILD
BINPERSID
""".split()
]  # written by torch.save


def read_archive(file: BinaryIO) -> Any:
    """Read what `torch.save` wrote: tables, lists, text, numbers and CPU tensors. Raises ValueError,
    pickle.UnpicklingError and what zipfile raises."""
    with ZipFile(file) as archive:
        parts = archive.infolist()
        names = [part.filename for part in parts]
        root = names[0].partition("/")[0] if names else ""
        if f"{root}/constants.pkl" in names:
            raise ValueError("it is a TorchScript program")
        if len(set(names)) < len(names):
            raise ValueError("two of its parts have the same name")
        if min((part.header_offset for part in parts), default=0) > 0:
            raise ValueError("there is something before the archive")
        size = os.fstat(file.fileno()).st_size
        if sum(part.file_size for part in parts) > size or any(part.compress_type for part in parts):
            raise ValueError("its parts are compressed, or larger than the file")
        if f"{root}/byteorder" in names and archive.read(f"{root}/byteorder") != sys.byteorder.encode():
            raise ValueError("it is of a machine with another byte order")
        return _Reader(archive, root).load()


class _Opcodes(dict[int, Callable[[Any], None]]):
    def __missing__(self, code: int) -> Any:
        raise pickle.UnpicklingError(f"the instruction {code:#x} is not allowed in it")


class _Reader(pickle._Unpickler):
    """Python's own unpickler, as the one in C allocates by numbers of the file, and lets it set any attribute."""

    stack: list[Any]
    pop_mark: Callable[[], list[Any]]

    dispatch = _Opcodes((ord(code), pickle._Unpickler.dispatch[ord(code)]) for code in _CODES)

    def __init__(self, archive: ZipFile, root: str) -> None:
        super().__init__(BytesIO(archive.read(f"{root}/data.pkl")))
        self._archive, self._root = archive, root
        self._storages: dict[str, Tensor] = {}

    def find_class(self, module: str, name: str) -> Any:
        if module == "torch" and name in _STORAGES:
            return _STORAGES[name]
        if (module, name) not in _FUNCTIONS:
            raise pickle.UnpicklingError(f"{f'{module}.{name}'[:100]!r} is not allowed in it")
        return _FUNCTIONS[module, name]

    def persistent_load(self, pid: Any) -> Tensor:
        """Read a storage as numbers [count]."""
        _, dtype, key, _, count = pid
        if key not in self._storages:
            part = self._archive.getinfo(f"{self._root}/data/{key}")
            self._storages[key] = torch.empty(part.file_size, dtype=torch.uint8)
            with self._archive.open(part) as file:
                assert isinstance(file, ZipExtFile)
                file.readinto(self._storages[key].numpy().data)
        raw = self._storages[key]
        if len(raw) != count * dtype.itemsize or (dtype == torch.bool and bool((raw > 1).any())):
            raise ValueError(f"{key} does not hold {count} numbers of {dtype}")
        return raw.view(dtype)

    def _ignore_state(self) -> None:  # _metadata of torch.nn, byte order of numpy
        self.stack.pop()

    def _set_item(self) -> None:
        self._set_items([self.stack.pop(-2), self.stack.pop()])

    def _set_items(self, items: list[Any] | None = None) -> None:
        items = self.pop_mark() if items is None else items
        if not isinstance(self.stack[-1], dict):
            raise pickle.UnpicklingError("an entry is set of what is no table")
        self.stack[-1].update(zip(items[::2], items[1::2], strict=True))

    dispatch.update({pickle.BUILD[0]: _ignore_state, pickle.SETITEM[0]: _set_item, pickle.SETITEMS[0]: _set_items})


def _tensor(numbers: Tensor, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any) -> Tensor:
    if not all(type(n) is int and n >= 0 for n in (offset, *size, *stride)) or len(size) != len(stride):
        raise ValueError("a tensor's size is not a size")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if math.prod(size) > len(numbers) or (0 not in size and last >= len(numbers)):
        raise ValueError(f"a tensor {list(size)} is larger than its {len(numbers)} numbers")
    return numbers.as_strided(size, stride, offset) if 0 not in size else numbers.new_empty(size)


def _encode(text: str, _: str) -> bytes:
    """Return the bytes of a number, which protocol 2 has as text."""
    if len(text) > 8:
        raise ValueError("it holds bytes that are no number")
    return text.encode("latin1")


def _number(kind: str, data: bytes) -> Any:
    """Return one of numpy's numbers, which schedulers leave, as Python's."""
    if kind not in ("f4", "f8", "i4", "i8"):
        raise ValueError("it holds a number of unknown type")
    return np.frombuffer(data, kind)[0].item()


_FUNCTIONS: dict[tuple[str, str], Callable[..., Any]] = {
    ("collections", "OrderedDict"): lambda: OrderedDict(),
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): lambda value, *_: value,
    ("_codecs", "encode"): _encode,
    ("numpy", "dtype"): lambda kind, *_: kind,
    ("numpy.core.multiarray", "scalar"): _number,
    ("numpy._core.multiarray", "scalar"): _number,
}
