"""Binary little-endian PLY files of one element, `vertex`, with float and int properties."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

_TYPES = {"float": "<f4", "float32": "<f4", "int": "<i4", "int32": "<i4"}
_HEADER_LIMIT = 1 << 16


class PlyError(ValueError):
    """The bytes are not a PLY file of the kind this module writes; the message says what is wrong."""


def write_ply(path: str | Path, columns: Mapping[str, npt.NDArray], comments: Sequence[str] = ()) -> None:
    """Writes the columns as properties of `vertex`, in their order.

    Args:
        path: file to write.
        columns: name to [N] array; integer columns become `int`, the others `float`.
        comments: header comments, one line each.
    """
    count = {len(column) for column in columns.values()}
    if len(count) != 1:
        raise PlyError(f"the columns of a PLY file need one length, not {sorted(count)}")
    integer = {name: np.issubdtype(column.dtype, np.integer) for name, column in columns.items()}
    rows = np.empty(count.pop(), dtype=[(name, "<i4" if integer[name] else "<f4") for name in columns])
    for name, column in columns.items():
        rows[name] = column
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header += [f"element vertex {len(rows)}"]
    header += [f"property {'int' if integer[name] else 'float'} {name}" for name in columns]
    with open(path, "wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        file.write(rows.tobytes())


def parse_ply(data: bytes) -> dict[str, npt.NDArray]:
    """Reads a file written by `write_ply`.

    Returns:
        name to [N] float32 or int32 array, in the file's order.

    Raises:
        PlyError: another kind of PLY, a length that does not match the header, or a value that is not finite.
    """
    header, body = _split(data)
    count, dtype = _layout(header)
    expected = count * dtype.itemsize
    if len(body) != expected:
        raise PlyError(f"truncated or too long: {count} vertices need {expected} bytes, the file has {len(body)}")
    rows = np.frombuffer(body, dtype=dtype)
    columns = {name: np.ascontiguousarray(rows[name]) for name in dtype.names or ()}
    for name, column in columns.items():
        bad = ~np.isfinite(column)
        if bad.any():
            raise PlyError(f"{name} is not finite in row {int(np.flatnonzero(bad)[0])}")
    return columns


def _split(data: bytes) -> tuple[list[str], memoryview]:
    end = data.find(b"end_header\n", 0, _HEADER_LIMIT)
    if not data.startswith(b"ply\n") or end < 0:
        raise PlyError("not a PLY file")
    try:
        header = data[:end].decode("ascii").split("\n")[1:-1]
    except UnicodeDecodeError as error:
        raise PlyError("the PLY header is not ASCII text") from error
    return header, memoryview(data)[end + len(b"end_header\n") :]


def _layout(header: Sequence[str]) -> tuple[int, np.dtype]:
    """Number of vertices and the type of one, from the header's lines."""
    count: int | None = None
    properties: list[tuple[str, str]] = []
    if not header or header[0] != "format binary_little_endian 1.0":
        raise PlyError("not a binary little-endian PLY file of version 1.0")
    for line in header[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "element" and len(words) == 3 and words[1] == "vertex" and count is None:
            if not words[2].isdecimal() or len(words[2]) > 10:
                raise PlyError(f"the vertex count {words[2]!r} is not a number")
            count = int(words[2])
        elif words[0] == "property" and len(words) == 3 and words[1] in _TYPES and count is not None:
            properties.append((words[2], _TYPES[words[1]]))
        else:
            raise PlyError(f"the PLY header has a line that is not understood: {line!r}")
    if count is None or not properties:
        raise PlyError("the PLY header declares no vertices")
    if len({name for name, _ in properties}) != len(properties):
        raise PlyError("the PLY header declares a property twice")
    return count, np.dtype(properties)
