"""Checkpoints made to harm whoever loads them, from the bytes of one that loads; JSON with odd entries."""

import copy
import io
import os
import pickle
import random
import tarfile
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch

Make = Callable[[bytes, Path], bytes]  # of a good checkpoint's bytes, and a file that code in the result would make


ODD_NUMBERS = (0, -1, 1, 2, 255, 0.1, -0.0, 1e-300, 5e-324, 1e9, 1e308, -1e308, float("nan"), float("inf"), 10**400)
ODD_NUMBERS += (2**31, 2**62, True, False)
ODD_TEXTS = ("", "x", "32", "\0", "../../x", "images", "pixel", "sh", "/", "\u202e\ud800", "x" * 5000, "OPENCV", "é/..")
ODD_VALUES = (*ODD_NUMBERS, *ODD_TEXTS, None, [], {}, [[]], [1.0, 2.0, 3.0], [[0.0] * 4] * 4, {"a": None})


def nodes(value: Any) -> list[tuple[Any, Any]]:
    """List all entries of nested dicts and lists, as container and key."""
    found = []
    for key in list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        found += [(value, key), *nodes(value[key])]
    return found


def mutated(value: Any, dice: random.Random, odd: Sequence[Any] = ODD_VALUES) -> Any:
    """Replace, remove, copy or scale one to three values in nested dicts and lists, or rename their keys."""
    value = copy.deepcopy(value)
    for _ in range(dice.choice((1, 1, 2, 3))):
        (holder, key), (other, name) = dice.choice(places := nodes(value)), dice.choice(places)
        kind, number = dice.randrange(6), holder[key] if isinstance(holder[key], (int, float)) else None
        if kind == 0:
            del holder[key]
        elif kind == 1:
            holder[key] = copy.deepcopy(other[name])
        elif kind == 2 and number is not None and not isinstance(number, bool) and abs(number) <= 1e308:
            holder[key] = max(-1e308, min(number * dice.choice((-1, 0.5, 2, 10, 1e6, 1e-6, 1e30)), 1e308))
        elif kind == 3 and isinstance(holder, dict):
            holder[key + "x"] = holder.pop(key)
        else:
            holder[key] = copy.deepcopy(dice.choice(odd))
    return value


class Call:
    """An object whose pickle calls a function."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


def saved(value: Any, **options: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(value, buffer, **options)
    return buffer.getvalue()


def commanded(ran: Path) -> Call:
    return Call(os.system, f"touch {ran}")


def tensor(offset: Any = 0, size: Any = (3,), stride: Any = (1,)) -> Make:
    """Make a tensor of three numbers that says that it has others."""
    arguments = (offset, size, stride, False, OrderedDict())
    return lambda whole, ran: saved({"a": Call(torch._utils._rebuild_tensor_v2, torch.ones(3).storage(), *arguments)})


def parts(change: Callable[[dict[str, bytes], Path], Iterable[tuple[str, bytes]]], kind: int = 0) -> Make:
    """Write other parts, by those of the archive, with a compression of zipfile."""

    def make(whole: bytes, ran: Path) -> bytes:
        with zipfile.ZipFile(io.BytesIO(whole)) as archive:
            held = {name.partition("/")[2]: archive.read(name) for name in archive.namelist()}
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", kind) as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # two parts of one name
            for name, data in change(held, ran):
                archive.writestr(f"archive/{name}", data)
        return buffer.getvalue()

    return make


def pickled(change: Callable[[bytes], bytes]) -> Make:
    """Change the archive's pickle."""
    return parts(lambda held, ran: (held | {"data.pkl": change(held["data.pkl"])}).items())


def twice(held: dict[str, bytes], ran: Path) -> list[tuple[str, bytes]]:
    return [*held.items(), ("data.pkl", pickle.dumps(commanded(ran), 2))]


def script(whole: bytes, ran: Path) -> bytes:
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.save(torch.jit.script(torch.nn.Linear(1, 1)), buffer)
    return buffer.getvalue()


def tar_and_zip(whole: bytes, ran: Path) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for name in ("storages", "tensors", "pickle"):
            data = saved(commanded(ran), _use_new_zipfile_serialization=False)
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return buffer.getvalue() + whole


def laughing(whole: bytes, ran: Path) -> bytes:
    """Nest a list of two of itself, 60 levels deep."""
    value: Any = ["ha"]
    for _ in range(60):
        value = [value, value]
    return saved({"step": value, "pipeline": value, "optimizers": {}})


KNOWN: dict[str, tuple[Make, str]] = {
    "TorchScript": (script, "it is a TorchScript program"),
    "tar and zip": (tar_and_zip, "there is something before the archive"),
    "two entries of one name": (parts(twice), "two of its parts have the same name"),
    "bytes before the archive": (lambda whole, ran: b"#!/bin/sh\n" + whole, "there is something before the archive"),
    "truncated": (lambda whole, ran: whole[: len(whole) // 2], "File is not a zip file"),
    "os.system": (lambda whole, ran: saved({"step": commanded(ran)}), "'posix.system' is not allowed in it"),
}
"""Known attacks, each with its message."""

HOSTILE: dict[str, tuple[Make, str]] = KNOWN | {
    "not an archive": (
        lambda whole, ran: saved({"step": commanded(ran)}, _use_new_zipfile_serialization=False),
        "File is not a zip file",
    ),
    "nested": (laughing, "is not a checkpoint of this method"),
    "compressed": (parts(lambda held, ran: held.items(), zipfile.ZIP_DEFLATED), "its parts are compressed"),
    "byte order": (
        parts(lambda held, ran: (held | {"byteorder": b"big"}).items()),
        "of a machine with another byte order",
    ),
    "memo of 32 GB": (pickled(lambda data: data[:2] + b"}r\xff\xff\xff\xff0" + data[2:]), "0x30 is not allowed"),
    "eval": (lambda whole, ran: saved(Call(eval, f"open({str(ran)!r}, 'w')")), "'__builtin__.eval' is not allowed"),
    "instruction INST": (pickled(lambda data: b"\x80\x02(S'a'\nios\nsystem\n."), "0x53 is not allowed"),
    "protocol 4": (lambda whole, ran: saved({"a": 1}, pickle_protocol=4), "0x95 is not allowed"),
    "attribute of a function": (
        pickled(lambda data: b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\nq\x00N}X\x01\x00\x00\x00aK\x01s\x86b."),
        "is not a nerfstudio checkpoint",
    ),
    "method of a tensor": (lambda whole, ran: saved(Call(torch.Tensor.apply_, torch.ones(3))), "getattr. is not allow"),
    "entry of no table": (pickled(lambda data: b"\x80\x02]K\x00K\x01s."), "set of what is no table"),
    "entries of no table": (pickled(lambda data: b"\x80\x02](K\x00K\x01u."), "set of what is no table"),
    "sparse": (lambda whole, ran: saved({"a": torch.ones(3).to_sparse()}), "_rebuild_sparse_tensor. is not allowed"),
    "huge table": (lambda whole, ran: saved(Call(OrderedDict, [(1, 2)])), "0 positional arguments"),
    "storage too small": (
        pickled(lambda data: data.replace(b"K\x0fN", b"K\x0eN").replace(b"K\x0ft", b"K\x0et")),
        "does not hold 14 numbers of torch.float32",
    ),
    "larger than its numbers": (tensor(size=(4,)), "larger than its 3 numbers"),
    "beyond its numbers": (tensor(offset=1), "larger than its 3 numbers"),
    "spread beyond them": (tensor(size=(2,), stride=(3,)), "larger than its 3 numbers"),
    "before them": (tensor(offset=-1), "size is not a size"),
    "backwards": (tensor(stride=(-1,)), "size is not a size"),
    "sizes of two lengths": (tensor(stride=()), "size is not a size"),
    "size that is no number": (tensor(size=(True,)), "size is not a size"),
    "repeated numbers": (tensor(size=(2**62,), stride=(0,)), "larger than its 3 numbers"),
    "empty and huge": (tensor(size=(0, 2**80), stride=(1, 1)), "cannot be read"),
}
