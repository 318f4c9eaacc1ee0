"""Binary little-endian PLY files with float and int properties: the element `vertex`, and perhaps others after it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

_TYPES = {"float": "<f4", "float32": "<f4", "int": "<i4", "int32": "<i4"}
HEADER_LIMIT = 1 << 16
"""No header is longer, in bytes."""


class PlyError(ValueError):
    """The bytes are not a PLY file of the kind this module writes; the message says what is wrong."""


def write_ply(
    path: str | Path,
    columns: Mapping[str, npt.NDArray],
    comments: Sequence[str] = (),
    more: Mapping[str, Mapping[str, npt.NDArray]] | None = None,
) -> None:
    """Writes the columns as properties of `vertex`, in their order.

    Args:
        path: file to write.
        columns: name to [N] array; integer columns become `int`, the others `float`.
        comments: header comments, one line each.
        more: columns of further elements by their name, in the order in which they follow.
    """
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    body = []
    for element, properties in {"vertex": columns, **(more or {})}.items():
        count = {len(column) for column in properties.values()}
        if len(count) != 1:
            raise PlyError(f"the columns of a PLY element need one length, not {sorted(count)}")
        integer = {name: np.issubdtype(column.dtype, np.integer) for name, column in properties.items()}
        rows = np.empty(count.pop(), dtype=[(name, "<i4" if integer[name] else "<f4") for name in properties])
        for name, column in properties.items():
            rows[name] = column
        header += [f"element {element} {len(rows)}"]
        header += [f"property {'int' if integer[name] else 'float'} {name}" for name in properties]
        body.append(rows)
    with open(path, "wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        for rows in body:
            file.write(rows.tobytes())


@dataclass(frozen=True)
class Header:
    """What a PLY file declares.

    Attributes:
        elements: element to its number of rows and the type of one, in the file's order.
        start: where the rows begin, bytes.
    """

    elements: dict[str, tuple[int, np.dtype]]
    start: int

    @property
    def nbytes(self) -> int:
        """Size of the whole file."""
        return self.start + sum(count * dtype.itemsize for count, dtype in self.elements.values())


def read_header(data: bytes | bytearray, size: int) -> Header:
    """The header of a file, from its first `HEADER_LIMIT` bytes or more.

    Args:
        data: how the file begins.
        size: bytes of the whole file.

    Raises:
        PlyError: another kind of PLY, or a size that does not match.
    """
    end = data.find(b"end_header\n", 0, HEADER_LIMIT)
    if not data.startswith(b"ply\n") or end < 0:
        raise PlyError("not a PLY file")
    try:
        lines = data[:end].decode("ascii").split("\n")[1:-1]
    except UnicodeDecodeError as error:
        raise PlyError("the PLY header is not ASCII text") from error
    header = Header(_layout(lines), end + len(b"end_header\n"))
    if header.nbytes != size:
        counts = ", ".join(f"{count} of {element}" for element, (count, _) in header.elements.items())
        raise PlyError(f"truncated or too long: {counts} need {header.nbytes} bytes, the file has {size}")
    return header


def parse_ply(data: bytes | bytearray) -> dict[str, dict[str, npt.NDArray]]:
    """Reads a file written by `write_ply`.

    Returns:
        element to name to [N] float32 or int32 array, in the file's order; the first element is `vertex`.

    Raises:
        PlyError: another kind of PLY, a length that does not match the header, or a value that is not finite.
    """
    header = read_header(data, len(data))
    elements, at = {}, header.start
    for element, (count, dtype) in header.elements.items():
        rows = np.frombuffer(data, dtype=dtype, count=count, offset=at)
        at += rows.nbytes
        elements[element] = {name: np.ascontiguousarray(rows[name]) for name in dtype.names or ()}
        for name, column in elements[element].items():
            bad = ~np.isfinite(column)
            if bad.any():
                raise PlyError(f"{name} is not finite in row {int(np.flatnonzero(bad)[0])}")
    return elements


def _layout(header: Sequence[str]) -> dict[str, tuple[int, np.dtype]]:
    """Number of rows of every element and the type of one, from the header's lines."""
    found: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    element = ""
    if not header or header[0] != "format binary_little_endian 1.0":
        raise PlyError("not a binary little-endian PLY file of version 1.0")
    for line in header[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "element" and len(words) == 3 and words[1] not in found:
            element = words[1]
            if not re.fullmatch(r"[0-9]{1,10}", words[2]):
                raise PlyError(f"the count {words[2]!r} of the element {element} is not a number")
            found[element] = (int(words[2]), [])
        elif words[0] == "property" and len(words) == 3 and words[1] in _TYPES and element:
            found[element][1].append((words[2], _TYPES[words[1]]))
        else:
            raise PlyError(f"the PLY header has a line that is not understood: {line!r}")
    if next(iter(found), "") != "vertex" or not all(properties for _, properties in found.values()):
        raise PlyError("the PLY header declares no vertices, or an element without properties")
    for _, properties in found.values():
        if len({name for name, _ in properties}) != len(properties):
            raise PlyError("the PLY header declares a property twice")
    return {element: (count, np.dtype(properties)) for element, (count, properties) in found.items()}
